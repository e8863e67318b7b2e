"""The page that lies beside the files of an export: what they are, and how they are used."""

from collections.abc import Iterable

from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.export.program import Program
from fleet_slip.models.model_version import ModelVersion

AXES = "x forward, y left, z up; angles and yaw rate are positive to the left (ISO 8855)"

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

_USE = {
    "c": """    cc -std=c99 {prefix}.c {prefix}_test.c -o self_test && ./self_test

Call `{prefix}_start` when a drive begins, and `{prefix}_step` at every tick.""",
    "sql": "Run the statement in `fleet-slip shell`, or in any engine that has a table `log`.",
    "dbc": "Load it into the tool that plans the bus. One message tells that there is an angle.",
    "onnx": "Give it a tick, and the state that it returned at the tick before.",
    "fmu": """In Simulink: the block FMU (Import), with a fixed step of one tick. With fmpy:

    fmpy simulate {prefix}_fmi2.fmu --output-interval {tick_s:g}""",
}


def read_me(
    version: ModelVersion, program: Program, target: str, prefix: str, names: Iterable[str]
) -> str:
    """Return the page, in Markdown."""
    angle, trained = program.angle, version.manifest.trained_on
    tick_s = float(SAMPLE_TIME_S)
    files = "\n".join(f"| `{name}` | {_what(name)} |" for name in names)
    inputs = "\n".join(
        f"| `{one.name}` | {one.unit} | {one.scale:f} | {one.min_count} to {one.max_count} |"
        for one in program.signals
    )
    return f"""# {version.reference}

Estimates `{angle.column}` in {angle.unit}, from {trained.drives:,} drives. Exported by fleet-slip.

| file | is |
| --- | --- |
{files}

## What it is given, every {tick_s:g} s

A tick is {tick_s:g} s. Physical value = scale * count. Axes: {AXES}.

| input | unit | scale | valid counts |
| --- | --- | --- | --- |
{inputs}

It gives `{angle.column}` in {angle.unit}: counts of {angle.scale:f}, within
{float(angle.error):.6f} counts of the exact model. Where an input is missing or out of its range,
there is no angle until all columns have a value again.

## How it is used

{_USE[target].format(prefix=prefix, tick_s=tick_s)}
"""


def _what(name: str) -> str:
    return next(text for end, text in _FILES.items() if name.endswith(end))
