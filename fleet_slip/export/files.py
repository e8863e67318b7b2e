"""The files of an export: JSON document, C, SQL, DBC, ONNX, FMU; a README and a manifest."""

import base64
import hashlib
import json
import subprocess
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from platform import machine
from shutil import which
from tempfile import TemporaryDirectory
from typing import Any, get_args
from uuid import UUID

from fleet_slip.base import canonical_json, install_command, sha256_of
from fleet_slip.catalog.definitions import MAX_ATTRIBUTE
from fleet_slip.catalog.signals import COUNT_MAX, SAMPLE_TIME_S
from fleet_slip.columns.column_sql import PLAIN_SQL, SqlLayers, attribute_sql
from fleet_slip.errors import ConfigError, RefusedError, UsageError
from fleet_slip.export.c import c_header, c_source, count_costs
from fleet_slip.export.c_gram import c_gram_header, c_gram_source, sets_on_board
from fleet_slip.export.program import Program, Target
from fleet_slip.export.stepping import (
    TestVector,
    checks_csv,
    compile_program,
    make_checks,
)
from fleet_slip.export.templating import (
    c_prefix,
    distinct,
    file_prefix,
    fill_in_version,
    read_source,
)
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.warehouse.warehouse import Warehouse

# The JSON document is specified in docs/export.md. Integers that can need more than 53 bits are
# strings.

FORMAT = "fleet-slip estimator"
SCHEMA = 2
"""Version of the schema. It changes if an older implementation would compute other angles."""


@dataclass(frozen=True)
class Subject:
    """A version to export, with its program and its checks."""

    version: ModelVersion
    program: Program
    checks: tuple[TestVector, ...]
    drives: bytes | None
    """Content of the file with the training drives' hashes; None: unknown."""
    with_gram: bool = False

    @property
    def table(self) -> str:
        """The checks as a CSV file."""
        return checks_csv(self.program, self.checks)


def document_of(subject: Subject) -> dict[str, Any]:
    """Return the JSON document of a version; `sha256` covers all other keys."""
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
            {
                name: value
                for name, value in vars(check).items()
                if name != "car" and (name != "states" or value)
            }
            for check in subject.checks
        ],
    }
    return {**content, "sha256": sha256_of(canonical_json(content))}


def program_content(program: Program) -> dict[str, Any]:
    """Return the key `program` of the JSON document."""
    angle = program.angle
    return {
        "tick_s": str(float(SAMPLE_TIME_S)),
        "signals": [
            {
                "name": signal.name,
                "column": signal.column,
                "unit": signal.unit,
                "scale": f"{signal.scale:f}",
                "min": signal.min_count,
                "max": signal.max_count,
            }
            for signal in program.signals
        ],
        "facts": [
            {"name": fact.name, "largest": MAX_ATTRIBUTE}
            if fact.equals is None
            else {"name": fact.name, "equals": fact.equals}
            for fact in program.facts
        ],
        "numbers": [
            {"name": number.name, "unit": number.unit, "grain": f"{number.grain:f}"}
            for number in program.numbers
        ],
        "steps": [[step.name, *step.operands, *step.plain] for step in program.steps],
        "angle": {
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
        },
    }


def manifest_of(
    version: ModelVersion, program: Program, to: str, files: Mapping[str, bytes]
) -> dict[str, Any]:
    """Return the manifest of an export: version, error, costs, and hashes of the files."""
    angle = program_content(program)["angle"]
    return {
        "format": "fleet-slip export",
        "to": to,
        "model": version.reference,
        "sha256": version.sha256,
        "drives_sha256": version.manifest.trained_on.drives_sha256,
        **({"assumed": version.manifest.assumed} if version.manifest.assumed else {}),
        "angle": {key: angle[key] for key in ("column", "unit", "scale", "error")},
        "costs": count_costs(program).as_dict(),
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }


def export_files(
    version: ModelVersion, warehouse: Warehouse | None, to: str, *, with_gram: bool = False
) -> dict[str, bytes]:
    """Return the files of an export by name.

    `with_gram` adds C code that counts Gram rows in the car. The files contain no logged data.
    Raises `UsageError` for an unknown format, `ConfigError` without a required package or compiler,
    `StorageError` if the hashes of the training drives are missing, and as `compile_program`.
    """
    if to not in _WRITERS:
        raise UsageError(f"--to {to!r} is unknown. Choose from: {', '.join(get_args(Target))}.")
    if with_gram and to != "c":
        raise UsageError(
            "--with-gram needs the format C. Run: fleet-slip export NAME --to c --with-gram"
        )
    subject = _subject(version, warehouse, with_gram=with_gram)
    files = {
        name: content.encode("utf-8") if isinstance(content, str) else content
        for name, content in _WRITERS[to](subject).items()
    }
    if to != "json":  # which contains all of this
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
    checks = make_checks(version.catalog, version.manifest, program)
    drives = None
    if warehouse is not None:
        drives = Registry.open(warehouse).trained_drives(version.manifest).content
    return Subject(version, program, checks, drives, with_gram)


def log_version(version: ModelVersion, warehouse: Warehouse, uri: str) -> str:
    """Log a version to an MLflow server and register it; return its number there.

    Raises `ConfigError` without the package, `UsageError` for a URI with a password, `StorageError`
    if the server rejects it, and as `export_files`.
    """
    from fleet_slip.export.mlflow import log_to_mlflow  # noqa: PLC0415 - mlflow imports this module

    aliases = Registry.open(warehouse).history(version.manifest.name).aliases()
    return log_to_mlflow(uri, _subject(version, warehouse), aliases)


def _json(subject: Subject) -> dict[str, str]:
    version = subject.version
    return {f"{version.manifest.name}-{version.version}.json": render(document_of(subject))}


def _c(subject: Subject) -> dict[str, str]:
    version, program = subject.version, subject.program
    prefix = c_prefix(version)
    total = sum(len(check.angles) for check in subject.checks)
    words = {"checks": subject.checks, "total": total}
    files = {
        f"{prefix}.h": c_header(version, program),
        f"{prefix}.c": c_source(version, program),
        f"{prefix}_test.c": fill_in_version("templates/self_test.c", version, program, **words),
        f"{prefix}_fuzz.c": fill_in_version("templates/fuzz.c", version, program),  # for libFuzzer
        # ASAM MCD-2 MC, with symbols: tools read the addresses from the linked program.
        f"{prefix}.a2l": fill_in_version("templates/estimator.a2l", version, program),
    }
    if subject.with_gram:
        sets = sets_on_board(version.catalog, version.manifest)
        files[f"{prefix}_gram.h"] = c_gram_header(version.catalog, prefix, sets)
        files[f"{prefix}_gram.c"] = c_gram_source(version.catalog, prefix, sets)
    return files


# The SQL statement is one SELECT over rows in SI units, for DuckDB, SQLite and PostgreSQL. Values
# that are used more than once are columns of a layer of their own.


def _sql(subject: Subject) -> dict[str, str]:
    """Return the statement for the view `log`, and as a macro of DuckDB for any table.

    The columns are `drive_id`, `tick`, and the angle in counts and in SI units, or null.
    """
    version, program = subject.version, subject.program
    if program.states:
        raise RefusedError(
            f"{version.reference} contains a filter, a recursion over the ticks of a drive, which "
            "no SQL of a row computes. Export it as c, fmu, onnx or json."
        )
    prefix, layers = file_prefix(version), [*_input_layers(program), *_step_layers(program)]

    def statement(rows: str, macro: str = "") -> str:
        words = {"layers": layers, "rounded": _sql_angle(program), "rows": rows, "macro": macro}
        return fill_in_version("templates/statement.sql", version, program, **words)

    macro = f"{program.angle.name}_{version.manifest.name}"
    return {
        f"{prefix}.sql": statement("log"),
        f"{prefix}_macro.sql": statement("query_table(source)", macro),
        f"{prefix}_checks.csv": subject.table,
    }


def _input_layers(program: Program) -> list[list[str]]:
    """Return layers that round inputs to counts, signals half to even; null is out of range."""
    counts, rounded, valid = [], [], []
    for place, signal in enumerate(program.signals):
        ratio = f"ratio_{place}"
        counts.append(f"{signal.column} / {signal.scale:f} AS {ratio}")
        half = f"CASE WHEN ABS({ratio} - ROUND({ratio})) = 0.5 THEN 2 * ROUND({ratio} / 2)"
        rounded.append(f"{half} ELSE ROUND({ratio}) END AS rounded_{place}")
        ends = (signal.min_count, signal.max_count)
        valid.append(f"{_sql_within(f'rounded_{place}', *ends)} AS signal_{place}")
    for place, number in enumerate(program.numbers):
        counts.append(f"ROUND({number.name} / {number.grain:f}) AS ratio_number_{place}")
        valid.append(
            f"{_sql_within(f'ratio_number_{place}', -COUNT_MAX, COUNT_MAX)} AS number_{place}"
        )
    facts = [f"{attribute_sql(fact)} AS fact_{place}" for place, fact in enumerate(program.facts)]
    return [[*counts, *facts], rounded, valid]


def _sql_within(value: str, low: int, high: int) -> str:
    return f"CASE WHEN {value} BETWEEN {low} AND {high} THEN CAST({value} AS BIGINT) END"


def _step_layers(program: Program) -> list[list[str]]:
    """Return the columns of each layer; the last layer has both parts of the angle.

    These are the sums of the upper and of the lower parts of the coefficients; see `fixed_point`.
    """
    sql = SqlLayers(program.steps, program.ranges, PLAIN_SQL, lambda name, place: f"{name}_{place}")
    texts = [sql.text(step) for step, _ in program.angle.terms]
    last = max(layer for _, layer in texts)
    intercept, *coefficients = program.angle.parts
    for i, name in enumerate(("high", "low")):
        pairs = zip(coefficients, texts, strict=True)
        terms = " + ".join(f"({part[i]}) * {text}" for part, (text, _) in pairs)
        sql.layers[last + 1].append(f"{intercept[i]} + {terms} AS {name}")
    return [sql.layers[number] for number in sorted(sql.layers)]


def _sql_angle(program: Program) -> str:
    angle = program.angle
    shift = angle.bits - angle.low_bits
    carried = f"(high + {_sql_floor('low', angle.low_bits)} + {2 ** (shift - 1)})"
    return PLAIN_SQL["clip"].format(_sql_floor(carried, shift), angle.limit)


def _sql_floor(value: str, bits: int) -> str:
    """Return SQL of a value over 2^bits, rounded down, by its non-negative remainder."""
    size = 2**bits
    remainder = f"(({value} % {size} + {size}) % {size})"
    return f"CAST(ROUND(({value} - {remainder}) / {size}) AS BIGINT)"


FIRST_ID = 0x100
"""Identifier of the first CAN message, an example: the bus defines the real ones."""

SIGNALS_PER_MESSAGE = 4
"""Signals of 16 bits in a message of 8 bytes."""

MAX_DBC_NAME_CHARACTERS = 32


def _dbc(subject: Subject) -> dict[str, str]:
    """Write messages of four signals each, and one with the angle; raw values are counts."""
    version, program = subject.version, subject.program
    prefix = file_prefix(version)
    words = {
        "node": "fleet_slip",
        "names": distinct([signal.name for signal in program.signals], MAX_DBC_NAME_CHARACTERS),
        "longest_name": MAX_DBC_NAME_CHARACTERS,
        "first_id": FIRST_ID,
        "last_id": FIRST_ID + -(-len(program.signals) // SIGNALS_PER_MESSAGE),
        "per_message": SIGNALS_PER_MESSAGE,
        "missing": -(2**15),
        "tick_ms": round(1000 * SAMPLE_TIME_S),
    }
    return {
        f"{prefix}.dbc": fill_in_version("templates/estimator.dbc", version, program, **words),
        f"{prefix}_checks.csv": subject.table,
    }


def _onnx(subject: Subject) -> dict[str, str | bytes]:
    try:
        from fleet_slip.export.onnx import onnx_model  # noqa: PLC0415 - optional package
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the format ONNX needs the package {error.name}. {install_command('onnx')}"
        ) from None
    version, program = subject.version, subject.program
    prefix = file_prefix(version)
    return {
        f"{prefix}_float32.onnx": onnx_model(version, program, "float32"),
        f"{prefix}_float64.onnx": onnx_model(version, program, "float64"),
        f"{prefix}_checks.csv": subject.table,
    }


# An FMU for co-simulation (FMI 2.0, https://fmi-standard.org), with sources and a binary for Linux.
#
# Inputs are the signals and the output is the angle, in SI units. One tick is 10 ms. Parameters are
# the properties of the car, as whole numbers.

COMPILER = "cc"
COMPILE_TIMEOUT_S = 120
FILE_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of all files in the archive, so that an export is reproducible."""


def _fmu(subject: Subject) -> dict[str, bytes]:
    """Write the archive.

    Raises `ConfigError` without a C compiler, or on a machine other than x86-64.
    """
    version, program, prefix = subject.version, subject.program, c_prefix(subject.version)
    words = {
        "token": f"{{{UUID(version.sha256[:32])}}}",
        "about": f"{version.reference}, SHA-256 {version.sha256}, trained on drives with SHA-256 "
        f"{version.manifest.trained_on.drives_sha256}",
        "parameters": _parameters(program),
        "units": {
            unit: _base_units(unit)
            for unit in (*(signal.unit for signal in program.signals), program.angle.unit)
        },
        "valid": "true if there is an angle; otherwise the angle is 0",
    }
    sources = {
        f"{prefix}.h": c_header(version, program),
        f"{prefix}.c": c_source(version, program),
        "fmi_model.h": fill_in_version("fmu_sources/fmi_model.h", version, program, **words),
        "fmi2.c": read_source("fmu_sources/fmi2.c"),
    }
    description = fill_in_version("fmu_sources/modelDescription.xml", version, program, **words)
    content: dict[str, str | bytes] = {
        "modelDescription.xml": description,
        **{f"sources/{name}": text for name, text in sources.items()},
        f"binaries/linux64/{prefix}.so": _compile(sources),
        "resources/checks.csv": subject.table,
    }
    file = BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(zipfile.ZipInfo(name, FILE_TIME), data, zipfile.ZIP_DEFLATED)
    return {f"{file_prefix(version)}_fmi2.fmu": file.getvalue()}


def _compile(sources: Mapping[str, str]) -> bytes:
    """Compile the shared library for this machine."""
    if which(COMPILER) is None or machine() != "x86_64":
        raise ConfigError(
            "an FMU contains a binary for Linux on x86-64. Export it on such a machine with the C "
            f"compiler {COMPILER}. Run: apt-get install gcc libc6-dev"
        )
    with TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, "utf-8")
        files = [name for name in sources if name.endswith(".c")]
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"]
        result = subprocess.run(  # noqa: S603 - fixed arguments
            [COMPILER, *options, *files, "-o", "library.so", "-lm"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=COMPILE_TIMEOUT_S,
        )
        if result.returncode:
            raise ConfigError(f"{COMPILER} cannot compile the FMU: {result.stderr[-500:]}")
        return (Path(folder) / "library.so").read_bytes()


def _parameters(program: Program) -> list[tuple[str, str]]:
    """Return the names and descriptions of the parameters."""
    parameters = [
        (fact.field, "whole number" if fact.equals is None else f"1 if it is {fact.equals}, else 0")
        for fact in program.facts
    ] + [(n.name, f"in counts of {n.grain:f} {n.unit}") for n in program.numbers]
    names = distinct([name for name, _ in parameters])
    return [
        (name, f"{description}; -2147483648 if unknown")
        for name, (_, description) in zip(names, parameters, strict=True)
    ]


def _base_units(unit: str) -> str:
    """Return a unit as powers of SI base units."""
    powers: dict[str, int] = {}
    for sign, factor in zip((1, -1), unit.split("/"), strict=False):
        name = factor.rstrip("^0123456789")
        powers[name] = sign * int(factor[len(name) :].strip("^") or 1)
    return " ".join(f'{name}="{power}"' for name, power in powers.items() if name != "1")


def render(content: Mapping[str, Any]) -> str:
    """Return the text of a JSON document, with one line for each tick."""
    return _rendered(content, 0) + "\n"


def _rendered(value: Any, depth: int) -> str:
    """Return JSON text; containers of numbers and texts are written on one line."""
    is_mapping = isinstance(value, Mapping)
    items = value.values() if is_mapping else value
    if not isinstance(value, Mapping | list | tuple) or not any(
        isinstance(item, Mapping | list | tuple) for item in items
    ):
        return json.dumps(value, ensure_ascii=False, allow_nan=False)
    lines = [_rendered(item, depth + 1) for item in items]
    if is_mapping:
        lines = [f"{json.dumps(key)}: {line}" for key, line in zip(value, lines, strict=True)]
    start, end = "{}" if is_mapping else "[]"
    indent = "\n" + " " * (depth + 1)
    return start + indent + f",{indent}".join(lines) + "\n" + " " * depth + end


_WRITERS: dict[str, Callable[[Subject], Mapping[str, str | bytes]]] = {
    "json": _json,
    "c": _c,
    "sql": _sql,
    "dbc": _dbc,
    "onnx": _onnx,
    "fmu": _fmu,
}
