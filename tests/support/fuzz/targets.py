"""Targets of the fuzzer. Each makes one hostile input and calls the function behind a command.

It may raise `FleetSlipError`, which is an answer, and nothing else; and what it asserts must hold.
"""

import contextlib
import json
import random
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any, get_args

import duckdb
import numpy as np
import pyarrow as pa

from fleet_slip.catalog.features import FeatureFile
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.config import load_config
from fleet_slip.errors import FleetSlipError
from fleet_slip.grams.cohort import FoldKey, load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.ingest.mapping import Mapping, load_mapping
from fleet_slip.models.registry import Registry
from fleet_slip.models.request import SelectionRequest, load_model_list
from fleet_slip.models.score import score
from fleet_slip.models.select import run_selection
from fleet_slip.operations.forget import load_retention
from fleet_slip.resources import SHIPPED_CONFIGS, folder
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.roads import load_track
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.local import LocalFolder, data_root
from fleet_slip.storage.table import AppTransaction, Change
from fleet_slip.vehicle.parameters import load_vehicle
from fleet_slip.views import connect
from fleet_slip.warehouse.database import one_query
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.fuzz.files import MAPPINGS, csv_file, parquet_file
from tests.support.fuzz.logs import damaged_file
from tests.support.fuzz.mutate import WORDS, mutate_bytes, mutate_tree, to_json, to_toml
from tests.support.measured import ingest_file
from tests.support.model_lists import nested, write_list

Target = Callable[[random.Random, Path], None]
"""Takes the source of all choices, and an empty folder: all that may be written is below it."""

MODEL = "fuzzed"

FOLD_KEYS: tuple[FoldKey, ...] = get_args(FoldKey)


def no_progress(_more: int, _total: int) -> None:
    """Show nothing."""


# Measured files


def csv(rng: random.Random, place: Path) -> None:
    """Ingest a CSV file."""
    _ingest(rng, place, csv_file(rng), ".csv")


def parquet(rng: random.Random, place: Path) -> None:
    """Ingest a Parquet file."""
    _ingest(rng, place, parquet_file(rng), rng.choice([".parquet", ".pq", ".csv", ""]))


def logs(rng: random.Random, place: Path) -> None:
    """Ingest a file of a format of test departments: MDF, CAN traces, MATLAB ..."""
    data, written = damaged_file(rng)
    _ingest(rng, place, data, written.suffix, written.mapping)


def _ingest(
    rng: random.Random, place: Path, data: bytes, suffix: str, mapping: Mapping | None = None
) -> None:
    """Ingest a file. It lands as its report says, or leaves the warehouse as it was."""
    file = place / f"measured{suffix}"
    file.write_bytes(data)
    warehouse = Warehouse(LocalFolder(place / "data"))
    chosen = mapping or rng.choice([*MAPPINGS, *MAPPINGS[:1] * 4])
    try:
        report = ingest_file(warehouse, file, chosen)
    except FleetSlipError:
        assert warehouse.logs.snapshot().rows == 0
        assert not list((place / "data").rglob("*.parquet"))
        raise
    assert report.new
    logs, quarantine = warehouse.logs.snapshot(), warehouse.quarantine.snapshot()
    assert logs.rows == report.counts.ticks > 0
    assert quarantine.rows == sum(report.counts.quarantined.values())


def names(rng: random.Random, place: Path) -> None:
    """Bring hostile names through the whole system: file, folder, vehicle, drive, track."""
    # No system has files with "/" or NUL in their names, or with names beyond 255 bytes.
    words = [word for word in WORDS if word not in {"", ".", ".."} and "/" not in word]
    words = [word for word in words if "\0" not in word and len(word.encode()) < 200]
    short = [word for word in WORDS if 0 < len(word) < 200 and "\0" not in word]
    root = place / rng.choice([*words, *["data"] * 20]) / "data"
    file = place / f"{rng.choice(words)}.csv"
    vehicle, track = rng.choice(short), rng.choice(WORDS)
    rows = "\n".join(
        f'{t / 100 + t // 20 * 9:.2f},{t % 7},{t % 5},"{vehicle.replace(chr(34), chr(34) * 2)}",{t}'
        for t in range(80)
    )
    file.write_bytes(f"t,ax,beta,car,day\n{rows}\n".encode())
    drive = {"day": "2024-05-31", "vehicle_id": {"column": "car"}, "vehicle_model": "sedan"}
    mapping = MAPPINGS[0].model_dump(mode="json", exclude_none=True)
    warehouse = Warehouse(data_root(root))
    ingest_file(
        warehouse, file, Mapping.model_validate({**mapping, "drive": drive}, context=SIGNALS)
    )
    update_grams(warehouse, no_progress)
    quoted = vehicle.strip().replace("'", "''")
    predicate = rng.choice(
        [*[f"vehicle_id = '{quoted}'"] * 5, f"track = '{track}'", vehicle, "true"]
    )
    with connect(root) as database:
        database.sql("FROM log").fetchall()
        database.sql("FROM drives").fetchall()
    load_cohort(warehouse, predicate)
    request = SelectionRequest(order="ax", group_by=rng.choice(FOLD_KEYS))
    run_selection(warehouse, request, predicate)


# Configurations

Load = Callable[[str], object]

LOADERS: dict[str, Load] = {
    "campaigns": lambda path: load_campaign(path, SHIPPED_CONFIGS),
    "mappings": lambda path: load_mapping(path, CATALOG),
    "models": lambda path: load_model_list(CATALOG, path),
    "scenarios": lambda path: load_scenario(path, SHIPPED_CONFIGS),
    "tracks": lambda path: load_track(path, SHIPPED_CONFIGS),
    "vehicles": lambda path: load_vehicle(path, SHIPPED_CONFIGS),
    "signals.toml": lambda path: load_config(Path(path), SignalCatalog),
    "features.toml": lambda path: load_config(Path(path), FeatureFile, SIGNALS),
    "retention.toml": lambda path: load_retention(path, SHIPPED_CONFIGS),
}


@cache
def shipped() -> tuple[tuple[Load, str], ...]:
    """Return every config of the package as text, with what loads it."""
    configs = Path(str(folder("configs")))
    return tuple(
        (load, file.read_text(encoding="utf-8"))
        for kind, load in LOADERS.items()
        for file in sorted((configs / kind).glob("*.toml") if "." not in kind else [configs / kind])
        if file.exists()
    )


def config(rng: random.Random, place: Path) -> None:
    """Load a config file with other keys, types, units, sizes or bytes."""
    load, text = rng.choice(shipped())
    if rng.random() < 0.8:
        tree = mutate_tree(rng, tomllib.loads(text, parse_float=Decimal))
        data = to_toml(tree).encode("utf-8", "surrogatepass")
    else:
        data = mutate_bytes(rng, text.encode())
    file = place / "config.toml"
    file.write_bytes(data)
    load(str(file))


# The data root


@cache
def _template(temporary: str) -> Path:
    """Make a small warehouse with a published model, once in a process."""
    root = Path(temporary) / "template"
    warehouse = Warehouse(LocalFolder(root))
    rng = np.random.default_rng(0)
    tables = [_drive(f"d{i}", rng.integers(-3000, 3000, (40, 5))) for i in range(6)]
    for number, drives in enumerate((tables[:3], tables[3:])):
        action = warehouse.logs.write_file(f"f{number}", pa.concat_tables(drives), _DAY)
        transaction = AppTransaction(f"fuzz/{number}", 1)
        warehouse.logs.snapshot().commit(Change(add=[action], transactions=[transaction]))
    program = "from fleet_slip.cli.main import main; main()"
    command = [sys.executable, "-c", program, "--root", str(root)]
    list_path = write_list(root.with_name("list.toml"), *nested("ax,ay"))
    for arguments in (["gram"], ["publish", MODEL, "--models", list_path, "--force"]):
        subprocess.run([*command, *arguments], check=True, capture_output=True)
    return root


def template(place: Path) -> Path:
    """Return a fresh copy of a small warehouse."""
    root = place / "data"
    shutil.copytree(_template(str(place.parent)), root)
    return root


_DAY = np.datetime64("2024-05-01").astype(object)


def _drive(drive_id: str, counts: np.ndarray[Any, Any]) -> pa.Table:
    facts = {"drive_id": drive_id, "vehicle_id": "car", "source": "simulated", "campaign": "fuzz"}
    signals = dict(
        zip(("ax", "ay", "yaw_rate", "steering_wheel", "sideslip"), counts.T, strict=True)
    )
    rows = len(counts)
    columns = {
        field.name: pa.array(signals[field.name], field.type)
        if field.name in signals
        else pa.array([facts.get(field.name)] * rows, field.type)
        for field in SIGNALS.log_schema
    }
    columns["day"] = pa.array([_DAY] * rows, pa.date32())
    columns["tick"] = pa.array(np.arange(rows), pa.int32())
    return pa.table(columns, schema=SIGNALS.log_schema)


def manifest(rng: random.Random, place: Path) -> None:
    """Change a manifest or a move of an alias, with its checksum or without, and use the model."""
    root = template(place)
    kind = rng.choice(["versions", "versions", "history"])
    file = root / "models" / MODEL / kind / "1.json"
    if rng.random() < 0.2:
        file.write_bytes(mutate_bytes(rng, file.read_bytes()))
    else:
        document = json.loads(file.read_text(encoding="utf-8"))
        document["content"] = mutate_tree(rng, document["content"])
        text = to_json(document)
        file.unlink()
        try:  # as a forger does
            folder = DocumentFolder(LocalFolder(root), f"models/{MODEL}/{kind}")
            folder.create(1, json.loads(text)["content"])
        except (ValueError, RecursionError):
            file.write_text(text, encoding="utf-8", errors="surrogatepass")
    if rng.random() < 0.1:
        file.rename(file.with_name(rng.choice(["2.json", "01.json", "9" * 200 + ".json"])))
    registry = Registry(LocalFolder(root), CATALOG)
    steps: list[Callable[[], object]] = [
        registry.as_table,
        registry.history(MODEL).moves,
        lambda: score(Warehouse(LocalFolder(root)), registry.resolve(MODEL).manifest, "true"),
    ]
    _all_refuse_or_answer(steps)


def delta_log(rng: random.Random, place: Path) -> None:
    """Change a Delta log, and read, aggregate and select."""
    root = template(place)
    logs = sorted((root / rng.choice(["logs", "grams"]) / "_delta_log").glob("*.json"))
    file = rng.choice(logs)
    if rng.random() < 0.3:
        file.write_bytes(mutate_bytes(rng, file.read_bytes()))
    else:
        lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        at = rng.randrange(len(lines))
        lines[at] = mutate_tree(rng, lines[at])
        paths = [line["add"] for line in lines if isinstance(line.get("add"), dict)]
        if paths and rng.random() < 0.3:
            rng.choice(paths)["path"] = rng.choice(WORDS)
        text = "\n".join(map(to_json, lines))
        file.write_text(text, encoding="utf-8", errors="surrogatepass")
    _use(root)


def data_file(rng: random.Random, place: Path) -> None:
    """Damage a file of logs or Gram rows under the program."""
    root = template(place)
    files = sorted((root / rng.choice(["logs", "grams"])).rglob("*.parquet"))
    file = rng.choice(files)
    file.write_bytes(mutate_bytes(rng, file.read_bytes(), edges=400))
    _use(root)


def _use(root: Path) -> None:
    warehouse = Warehouse(LocalFolder(root))

    def read(view: str) -> None:
        with connect(root) as database, contextlib.suppress(duckdb.Error):
            database.sql(f"FROM {view}").fetchall()  # in Python the errors are DuckDB's own

    def stays_inside() -> None:
        for table in (warehouse.logs, warehouse.grams):
            for path in table.snapshot().paths:
                assert Path(path).resolve().is_relative_to(Path(str(table.folder)).resolve()), path

    _all_refuse_or_answer(
        [
            stays_inside,
            lambda: read("log"),
            lambda: read("grams"),
            lambda: load_cohort(warehouse),
            lambda: run_selection(warehouse, SelectionRequest(order="ax,ay", folds=2)),
            lambda: score(
                warehouse, Registry(LocalFolder(root), CATALOG).resolve(MODEL).manifest, "true"
            ),
            lambda: update_grams(warehouse, no_progress),
        ]
    )


def _all_refuse_or_answer(steps: list[Callable[[], object]]) -> None:
    """Run every step, whether those before were refused or not."""
    refusal: FleetSlipError | None = None
    for step in steps:
        try:
            step()
        except FleetSlipError as error:
            refusal = error
    if refusal is not None:
        raise refusal


# SQL

_TABLES = ("log", "log_counts", "drives", "grams", "models", "dictionary", "quarantine", "runs")
_COLUMNS = ("ax_mps2", "drive_id", "ax", "tick", "day", "n", "sums", "*", "signals", "nothing")
_HOSTILE = (
    *("COPY (SELECT 1) TO 'stolen.csv'", "INSERT INTO models FROM models RETURNING *", "/*", "--"),
    *("DELETE FROM dictionary RETURNING *", "query('FROM drives')", "read_csv('/etc/passwd')", ";"),
    *("glob('*')", "getenv('HOME')", "read_parquet('/etc/passwd')", "'/etc/passwd'", "$1", "SET"),
    *("json_execute_serialized_sql('{}')", "EXPLAIN ANALYZE", "ATTACH 'x.db'", "repeat('x', 10)"),
    *("read_text('data')", "duckdb_settings()", "current_setting('home_directory')", "PRAGMA x"),
)


_PARTS = (
    *_TABLES,
    *_COLUMNS,
    *_HOSTILE,
    *("1", "'a'", "NULL", "1e308", "DATE '2024-05-01'", "range(3)", "log, drives"),
    *("sum(ax)", "CASE WHEN ax IS NULL THEN ay END", "[tick]", "CAST(day AS VARCHAR)"),
    *("count(*) FILTER (ax > ay)", "row_number() OVER (ORDER BY tick)"),
)


def _query(rng: random.Random, depth: int = 2) -> str:
    """Return SQL that is valid more often than not."""

    def part(parts: tuple[str, ...]) -> str:
        return rng.choice(parts if rng.random() < 0.8 else _PARTS)

    source = f"({_query(rng, depth - 1)}) AS s" if depth and rng.random() < 0.4 else part(_TABLES)
    verb = rng.choice([*["SELECT"] * 8, "EXPLAIN SELECT", "SUMMARIZE SELECT"])
    where = f" WHERE {part(_COLUMNS)} = {part(_COLUMNS)}"
    end = rng.choice(["", where, " LIMIT 3", " UNION ALL SELECT 1"])
    return f"{verb if depth == 2 else 'SELECT'} {part(_COLUMNS)} AS a FROM {source}{end}"


def sql(rng: random.Random, place: Path) -> None:
    """Ask what may be a query, as a query and as a cohort's condition."""
    root = _template(str(place.parent))
    before = _sizes(root)
    text = _query(rng)
    if rng.random() < 0.1:
        text = mutate_bytes(rng, text.encode()).decode("utf-8", "surrogateescape")
    try:
        if rng.random() < 0.1:
            load_cohort(Warehouse(LocalFolder(root)), text)
            return
        query = one_query(_connection(root), text)
        with contextlib.suppress(duckdb.Error):
            _connection(root).sql(query).limit(100).fetchall()
    finally:
        assert _sizes(root) == before


@cache
def _connection(root: Path) -> duckdb.DuckDBPyConnection:
    return connect(root)


def _sizes(root: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of change of every file below a folder."""
    return {
        str(file): (file.stat().st_size, file.stat().st_mtime_ns)
        for file in root.rglob("*")
        if file.is_file()
    }


TARGETS: dict[str, tuple[Target, int]] = {
    "csv": (csv, 20),
    "parquet": (parquet, 20),
    "logs": (logs, 10),
    "config": (config, 20),
    "sql": (sql, 12),
    "manifest": (manifest, 10),
    "data_file": (data_file, 2),
    "delta_log": (delta_log, 2),
    "names": (names, 1),
}
"""Each target with its share of the cases, in percent; those that take long have less."""
