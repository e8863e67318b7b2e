"""The files that an export of a published version consists of."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from fleet_slip.errors import ConfigError, UsageError
from fleet_slip.export.c.c_gram import c_gram_header, c_gram_source
from fleet_slip.export.c.c_names import c_prefix, file_prefix
from fleet_slip.export.c.c_source import (
    a2l_text,
    c_fuzz_target,
    c_header,
    c_self_test,
    c_source,
)
from fleet_slip.export.c.on_board import sets_on_board
from fleet_slip.export.checks import Check, checks_csv, make_checks
from fleet_slip.export.compile import compile_program
from fleet_slip.export.dbc import dbc_text
from fleet_slip.export.document import document_of, manifest_of
from fleet_slip.export.fill_templates import fill_in_version
from fleet_slip.export.fmu import fmu
from fleet_slip.export.program import Program
from fleet_slip.export.sql_source import sql_macro, sql_statement
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.trained_drives import pack_hashes
from fleet_slip.models.versions import Registry
from fleet_slip.warehouse.tables import Warehouse

Target = Literal["json", "c", "sql", "dbc", "onnx", "fmu"]
"""What a version can be exported to."""


@dataclass(frozen=True)
class Subject:
    """A version that is exported, its program, checks of it, and the hashes of its drives."""

    version: ModelVersion
    program: Program
    checks: tuple[Check, ...]
    drives: bytes | None
    with_gram: bool = False

    @property
    def stem(self) -> str:
        """What the names of its files begin with."""
        return f"{self.version.manifest.name}-{self.version.version}"


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
    program = compile_program(version.manifest)
    checks = make_checks(version.manifest, program)
    drives = None
    if warehouse is not None:
        made = Registry.of(warehouse).trained_drives(version.manifest)
        drives = pack_hashes(made.salted) if made else None
    return Subject(version, program, checks, drives, with_gram)


def log_version(version: ModelVersion, warehouse: Warehouse, uri: str) -> str:
    """Log a version to an MLflow server and register it; return the number that it has there.

    Raises `ConfigError` without the library, `UsageError` for a URI with a password, `StorageError`
    if the server does not take it, and what `export_files` raises.
    """
    from fleet_slip.export.mlflow_log import log_to_mlflow  # noqa: PLC0415 - it renders documents

    subject = _subject(version, warehouse)
    content = document_of(version, subject.program, subject.checks, subject.drives)
    aliases = Registry(warehouse.root / "models").history(version.manifest.name).aliases()
    return log_to_mlflow(uri, version, subject.program, subject.checks, content, aliases)


def _json(subject: Subject) -> dict[str, str]:
    content = document_of(subject.version, subject.program, subject.checks, subject.drives)
    return {f"{subject.stem}.json": render(content)}


def _c(subject: Subject) -> dict[str, str]:
    version, program = subject.version, subject.program
    prefix = c_prefix(version)
    sets = sets_on_board(version.manifest) if subject.with_gram else ()
    gram = (
        {
            f"{prefix}_gram.h": c_gram_header(prefix, sets),
            f"{prefix}_gram.c": c_gram_source(prefix, sets),
        }
        if sets
        else {}
    )
    return {
        f"{prefix}.h": c_header(version, program),
        f"{prefix}.c": c_source(version, program),
        f"{prefix}_test.c": c_self_test(version, program, subject.checks),
        f"{prefix}_fuzz.c": c_fuzz_target(version, program),
        f"{prefix}.a2l": a2l_text(version, program),
        **gram,
    }


def _sql(subject: Subject) -> dict[str, str]:
    version, program = subject.version, subject.program
    prefix = file_prefix(version)
    return {
        f"{prefix}.sql": sql_statement(version, program),
        f"{prefix}_macro.sql": sql_macro(version, program),
        f"{prefix}_checks.csv": checks_csv(program, subject.checks),
    }


def _dbc(subject: Subject) -> dict[str, str]:
    prefix = file_prefix(subject.version)
    return {
        f"{prefix}.dbc": dbc_text(subject.version, subject.program),
        f"{prefix}_checks.csv": checks_csv(subject.program, subject.checks),
    }


def _onnx(subject: Subject) -> dict[str, str | bytes]:
    try:
        from fleet_slip.export.onnx_graph import onnx_model  # noqa: PLC0415 - it is optional
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"ONNX needs the package {error.name}. Run: pip install 'fleet-slip[onnx]'"
        ) from None
    version, program = subject.version, subject.program
    prefix = file_prefix(version)
    return {
        f"{prefix}_float32.onnx": onnx_model(version, program, "float32"),
        f"{prefix}_float64.onnx": onnx_model(version, program, "float64"),
        f"{prefix}_checks.csv": checks_csv(program, subject.checks),
    }


def _fmu(subject: Subject) -> dict[str, bytes]:
    version, program = subject.version, subject.program
    prefix, checks = file_prefix(version), checks_csv(program, subject.checks)
    return {
        f"{prefix}_fmi2.fmu": fmu(version, program, checks, 2),
        f"{prefix}_fmi3.fmu": fmu(version, program, checks, 3),
    }


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
