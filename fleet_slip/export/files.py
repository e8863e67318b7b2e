"""The files that an export of a published version consists of."""

import base64
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.catalog.definitions import MAX_ATTRIBUTE
from fleet_slip.catalog.signals import SAMPLE_TIME_S
from fleet_slip.columns.lowering import VehicleAttribute
from fleet_slip.errors import ConfigError, UsageError
from fleet_slip.export.c import c_header, c_source
from fleet_slip.export.c_gram import c_gram_header, c_gram_source, sets_on_board
from fleet_slip.export.compile import Check, checks_csv, compile_program, make_checks
from fleet_slip.export.costs import count_costs
from fleet_slip.export.fmu import fmu
from fleet_slip.export.program import Angle, Input, Program, Target
from fleet_slip.export.sql_statement import sql_macro, sql_statement
from fleet_slip.export.templating import c_prefix, different, file_prefix, fill_in_version
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.warehouse.warehouse import Warehouse

# A program as a JSON document, from which an implementation can be written: docs/export.md.
#
# Whole numbers that may need more than 53 bits are texts.

FORMAT = "fleet-slip estimator"
SCHEMA = 2
"""Number of the schema: it changes if an implementation of before would compute something else."""


@dataclass(frozen=True)
class Subject:
    """A version that is exported, its program, and checks of it.

    `drives` is the content of the file about the drives that trained it; None if it is not known.
    """

    version: ModelVersion
    program: Program
    checks: tuple[Check, ...]
    drives: bytes | None
    with_gram: bool = False

    @property
    def table(self) -> str:
        """The checks as CSV."""
        return checks_csv(self.program, self.checks)


def document_of(subject: Subject) -> dict[str, Any]:
    """Return the document of a published version; `sha256` is of everything else in it."""
    version, drives = subject.version, subject.drives
    content: dict[str, Any] = {
        "format": FORMAT,
        "schema": SCHEMA,
        "model": {
            "reference": version.reference,
            "sha256": version.sha256,
            "drives_sha256": version.manifest.trained_on.drives_sha256,
            "drives": None if drives is None else base64.b64encode(drives).decode("ascii"),
            "manifest": version.manifest.model_dump(mode="json"),
        },
        "program": program_content(subject.program),
        "costs": count_costs(subject.program).as_dict(),
        "checks": [
            {name: value for name, value in vars(one).items() if name != "known"}
            for one in subject.checks
        ],
    }
    return {**content, "sha256": sha256_of(canonical_json(content))}


def program_content(program: Program) -> dict[str, Any]:
    """Return the program alone."""
    return {
        "tick_s": str(float(SAMPLE_TIME_S)),
        "signals": [_signal(one) for one in program.signals],
        "facts": [_fact(one) for one in program.facts],
        "numbers": [
            {"name": one.name, "unit": one.unit, "grain": f"{one.grain:f}"}
            for one in program.numbers
        ],
        "steps": [list(step) for step in program.steps],
        "angle": _angle(program.angle),
    }


def _signal(one: Input) -> dict[str, Any]:
    return {
        "name": one.name,
        "column": one.column,
        "unit": one.unit,
        "scale": f"{one.scale:f}",
        "min": one.min_count,
        "max": one.max_count,
    }


def _fact(one: VehicleAttribute) -> dict[str, Any]:
    if one.equals is not None:
        return {"name": one.name, "equals": one.equals}
    return {"name": one.name, "largest": MAX_ATTRIBUTE}


def _angle(angle: Angle) -> dict[str, Any]:
    return {
        "name": angle.name,
        "column": angle.column,
        "unit": angle.unit,
        "scale": f"{angle.scale:f}",
        "bits": angle.bits,
        "intercept": str(angle.intercept),
        "terms": [
            {"step": step, "coefficient": str(coefficient)} for step, coefficient in angle.terms
        ],
        "error": f"{angle.error.numerator}/{angle.error.denominator}",
        "largest": angle.largest,
        "limit": angle.limit,
    }


def manifest_of(
    version: ModelVersion, program: Program, to: str, files: Mapping[str, bytes]
) -> dict[str, Any]:
    """Return what is said of the files of an export: of which version, the error and the costs."""
    angle = program.angle
    return {
        "format": "fleet-slip export",
        "to": to,
        "model": version.reference,
        "sha256": version.sha256,
        "drives_sha256": version.manifest.trained_on.drives_sha256,
        **({"assumed": version.manifest.assumed} if version.manifest.assumed else {}),
        "angle": {
            "column": angle.column,
            "unit": angle.unit,
            "scale": f"{angle.scale:f}",
            "error": f"{angle.error.numerator}/{angle.error.denominator}",
        },
        "costs": count_costs(program).as_dict(),
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }


def export_files(
    version: ModelVersion, warehouse: Warehouse | None, to: str, *, with_gram: bool = False
) -> dict[str, bytes]:
    """Return the contents of an export by the names of their files.

    `with_gram` adds to C what counts Gram rows in the car.

    Nothing in it is of a drive of the warehouse. Raises `UsageError` for an unknown target, what
    `compile_program` raises, and `StorageError` if the hashes of its drives are gone. `ConfigError`
    says that a library is not installed.
    """
    if to not in _WRITERS:
        raise UsageError(f"{to!r}: export to one of {', '.join(get_args(Target))}.")
    if with_gram and to != "c":
        raise UsageError("only C has Gram rows. Run: fleet-slip export NAME --to c --with-gram")
    subject = _subject(version, warehouse, with_gram=with_gram)
    files = {
        name: content.encode("utf-8") if isinstance(content, str) else content
        for name, content in _WRITERS[to](subject).items()
    }
    if to != "json":  # that says all of it itself
        prefix = c_prefix(version) if to == "c" else file_prefix(version)
        last = f"{prefix}_{to}_manifest.json"  # a folder may hold several formats
        words = {"target": to, "stem": prefix, "names": [*files, last]}
        page = fill_in_version("templates/README.md", version, subject.program, **words)
        files[f"{prefix}_{to}_README.md"] = page.encode("utf-8")
        manifest = manifest_of(version, subject.program, to, files)
        files[last] = render(manifest).encode("utf-8")
    return files


def _subject(
    version: ModelVersion, warehouse: Warehouse | None, *, with_gram: bool = False
) -> Subject:
    program = compile_program(version.catalog, version.manifest)
    checks = make_checks(version.catalog.signals, version.manifest, program)
    drives = None
    if warehouse is not None:
        drives = Registry.of(warehouse).trained_drives(version.manifest).content
    return Subject(version, program, checks, drives, with_gram)


def log_version(version: ModelVersion, warehouse: Warehouse, uri: str) -> str:
    """Log a version to an MLflow server and register it; return the number that it has there.

    Raises `ConfigError` without the library, `UsageError` for a URI with a password, `StorageError`
    if the server does not take it, and what `export_files` raises.
    """
    from fleet_slip.export.mlflow import log_to_mlflow  # noqa: PLC0415 - it renders documents

    aliases = Registry.of(warehouse).history(version.manifest.name).aliases()
    return log_to_mlflow(uri, _subject(version, warehouse), aliases)


def _json(subject: Subject) -> dict[str, str]:
    version = subject.version
    return {f"{version.manifest.name}-{version.version}.json": render(document_of(subject))}


def _c(subject: Subject) -> dict[str, str]:
    version, program = subject.version, subject.program
    prefix = c_prefix(version)
    sets = sets_on_board(version.catalog, version.manifest) if subject.with_gram else ()
    gram = (
        {
            f"{prefix}_gram.h": c_gram_header(version.catalog, prefix, sets),
            f"{prefix}_gram.c": c_gram_source(version.catalog, prefix, sets),
        }
        if sets
        else {}
    )
    total = sum(len(check.angles) for check in subject.checks)
    tested = {"checks": subject.checks, "total": total}
    return {
        f"{prefix}.h": c_header(version, program),
        f"{prefix}.c": c_source(version, program),
        f"{prefix}_test.c": fill_in_version("templates/self_test.c", version, program, **tested),
        f"{prefix}_fuzz.c": fill_in_version("templates/fuzz.c", version, program),  # for libFuzzer
        # ASAM MCD-2 MC: symbols instead of addresses, which the tool takes from the linked program.
        f"{prefix}.a2l": fill_in_version("templates/estimator.a2l", version, program),
        **gram,
    }


def _sql(subject: Subject) -> dict[str, str]:
    version, program = subject.version, subject.program
    prefix = file_prefix(version)
    return {
        f"{prefix}.sql": sql_statement(version, program),
        f"{prefix}_macro.sql": sql_macro(version, program),
        f"{prefix}_checks.csv": subject.table,
    }


FIRST_ID = 0x100
"""Identifier of the first CAN message; whose bus it is decides."""

PER_MESSAGE = 4
"""Signals of 16 bits in a message of 8 bytes."""

LONGEST_DBC_NAME = 32


def _dbc(subject: Subject) -> dict[str, str]:
    """Write messages of four signals each, and one with the angle; raw values are counts."""
    version, program = subject.version, subject.program
    prefix = file_prefix(version)
    words = {
        "node": "fleet_slip",
        "names": different([one.name for one in program.signals], LONGEST_DBC_NAME),
        "longest_name": LONGEST_DBC_NAME,
        "first_id": FIRST_ID,
        "last_id": FIRST_ID + -(-len(program.signals) // PER_MESSAGE),
        "per_message": PER_MESSAGE,
        "missing": -(2**15),
        "tick_ms": round(1000 * SAMPLE_TIME_S),
    }
    return {
        f"{prefix}.dbc": fill_in_version("templates/estimator.dbc", version, program, **words),
        f"{prefix}_checks.csv": subject.table,
    }


def _onnx(subject: Subject) -> dict[str, str | bytes]:
    try:
        from fleet_slip.export.onnx import onnx_model  # noqa: PLC0415 - it is optional
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"ONNX needs the package {error.name}. Run: pip install 'fleet-slip[onnx]'"
        ) from None
    version, program = subject.version, subject.program
    prefix = file_prefix(version)
    return {
        f"{prefix}_float32.onnx": onnx_model(version, program, "float32"),
        f"{prefix}_float64.onnx": onnx_model(version, program, "float64"),
        f"{prefix}_checks.csv": subject.table,
    }


def _fmu(subject: Subject) -> dict[str, bytes]:
    archive = fmu(subject.version, subject.program, subject.table)
    return {f"{file_prefix(subject.version)}_fmi2.fmu": archive}


def render(content: Mapping[str, Any]) -> str:
    """Return a JSON document with a line for each of its parts, and for each tick."""
    return _rendered(content, 0) + "\n"


def _rendered(value: Any, depth: int) -> str:
    """Return JSON text; what is made of numbers and texts alone stands on one line."""
    items = value.values() if isinstance(value, Mapping) else value
    if not isinstance(value, Mapping | list | tuple) or not any(
        isinstance(one, Mapping | list | tuple) for one in items
    ):
        return json.dumps(value, ensure_ascii=False, allow_nan=False)
    indent, close = "\n" + " " * (depth + 1), "\n" + " " * depth
    if isinstance(value, Mapping):
        parts = [f"{json.dumps(key)}: {_rendered(one, depth + 1)}" for key, one in value.items()]
        return "{" + indent + f",{indent}".join(parts) + close + "}"
    return (
        "[" + indent + f",{indent}".join(_rendered(one, depth + 1) for one in value) + close + "]"
    )


_WRITERS: dict[str, Callable[[Subject], Mapping[str, str | bytes]]] = {
    "json": _json,
    "c": _c,
    "sql": _sql,
    "dbc": _dbc,
    "onnx": _onnx,
    "fmu": _fmu,
}
