"""The page that lies beside the files of an export: what they are, and how they are used."""

from collections.abc import Iterable

from fleet_slip.export.fill_templates import fill_in_version
from fleet_slip.export.program import Program
from fleet_slip.models.model_version import ModelVersion

_FILES = {
    "_test.c": "program of its own: runs the checks, and ends with 0 if all angles agree",
    "_fuzz.c": "target for `clang -fsanitize=fuzzer`",
    "_gram.h": "counts Gram rows in the car: header",
    "_gram.c": "counts Gram rows in the car",
    ".h": "header: what is given, what is kept, `start` and `step`",
    ".c": "the estimator in C99, in whole numbers; also for C++",
    ".a2l": "for calibration tools (ASAP2 1.71); its first lines say what to declare",
    "_macro.sql": "a table macro for DuckDB",
    ".sql": "a statement on the view `log`, in SI units",
    "_checks.csv": "inputs that are made up, and the angle at every tick",
    ".dbc": "messages of a CAN bus with the inputs and the angle",
    "_float32.onnx": "ONNX graph in single precision",
    "_float64.onnx": "ONNX graph in double precision",
    "_fmi2.fmu": "co-simulation unit after FMI 2.0, for Simulink and others",
    "_fmi3.fmu": "co-simulation unit after FMI 3.0",
    "_manifest.json": "version, costs, and the SHA-256 of each file",
}
"""What a file is, by the end of its name; longer ends stand before those that end them."""


def read_me(
    version: ModelVersion, program: Program, target: str, stem: str, names: Iterable[str]
) -> str:
    """Return the page, in Markdown; `stem` is what the names of files begin with."""
    named = {name: _what(name) for name in names}
    words = {"target": target, "stem": stem, "named": named}
    return fill_in_version("templates/README.md", version, program, **words)


def _what(name: str) -> str:
    return next(text for end, text in _FILES.items() if name.endswith(end))
