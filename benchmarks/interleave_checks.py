"""Invariants of concurrent commands: no row is lost or doubled, and no erased row returns."""

import contextlib
import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

import fleet_slip
from benchmarks.interleave_roots import ADDED, CAR, FIRST_DAY, ROWS
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import FleetSlipError
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.operations.forget import marked_models
from fleet_slip.operations.verify import verify
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import fit
from fleet_slip.storage.local import data_root
from fleet_slip.storage.table import Table
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS


@dataclass(frozen=True)
class Drive:
    """The facts of a drive."""

    day: str
    vehicle_id: str
    rows: int
    sha256: str


Drives = Mapping[str, Drive]


def warehouse_at(root: str) -> Warehouse:
    return Warehouse(data_root(root))


def drives_of(warehouse: Warehouse) -> tuple[dict[str, Drive], list[str]]:
    """Return the drives that the logs have, and those that they have twice."""
    drives: dict[str, Drive] = {}
    twice = []
    for file in warehouse.logs.snapshot().files:
        rows = warehouse.logs.read(file.path)
        for drive in rows["drive_id"].unique().to_pylist():
            part = rows.filter(pc.equal(rows["drive_id"].cast(pa.string()), drive))
            if drive in drives:
                twice.append(drive)
            drives[drive] = _described(part.sort_by("tick"), str(file.day))
    return drives, twice


def _described(rows: pa.Table, day: str) -> Drive:
    digest = hashlib.sha256()
    for name in ("tick", *SIGNALS.signals):
        if name != ADDED and name in rows.schema.names:
            digest.update(rows[name].fill_null(-32768).combine_chunks().to_numpy().tobytes())
    return Drive(day, rows["vehicle_id"][0].as_py(), rows.num_rows, digest.hexdigest())


def quarantined(warehouse: Warehouse) -> list[str]:
    """Return the cars of the refused rows."""
    table = warehouse.quarantine
    return sorted(
        str(row["vehicle_id"])
        for file in table.snapshot().files
        for row in table.read(file.path).to_pylist()
    )


def state(root: str) -> dict[str, Any]:
    """Return what the tables of a root hold, whatever files it is in."""
    warehouse = warehouse_at(root)
    drives, twice = drives_of(warehouse)
    return {
        "drives": {name: vars(drive) for name, drive in sorted(drives.items())},
        "twice": twice,
        "quarantine": quarantined(warehouse),
        "grams": sorted(grams_of(warehouse)),
        "damage": [str(finding) for finding in verify(warehouse, full=True).damage],
    }


def grams_of(warehouse: Warehouse) -> Iterator[str]:
    """Yield the drive of each Gram row of the signals that counts."""
    identity = CATALOG.identity(PLAIN)
    active = {file.path for file in warehouse.logs.snapshot().files}
    for file in warehouse.grams.snapshot().files:
        for row in warehouse.grams.read(file.path).to_pylist():
            if row["feature_set"] == identity and row["file"] in active:
                yield row["drive_id"]


def readers_findings(root: str, committed: Drives, erased: str) -> list[str]:
    """Return what a reader sees that is no whole state.

    Args:
        root: a data root, on which a command may have stopped.
        committed: those whose rows and Gram rows were there before.
        erased: what may be missing of them: "car", "day", "both" or "".
    """
    findings = []
    drives, twice = drives_of(warehouse_at(root))
    findings += [f"doubled: rows of {name}" for name in twice]
    findings += [
        f"damaged: rows of {name}"
        for name, contents in drives.items()
        if committed.get(name, contents) != contents
    ]
    needed = {name for name, drive in committed.items() if not may_be_missing(drive, erased)}
    findings += [f"lost: rows of {name}" for name in sorted(needed - drives.keys())]
    with fleet_slip.connect(root) as database:
        seen = database.execute(
            "SELECT drive_id, count(*), sum(row_count)::BIGINT FROM grams WHERE feature_set = $set "
            "GROUP BY ALL",
            {"set": CATALOG.identity(PLAIN)},
        ).fetchall()
    findings += [f"doubled: Gram row of {name}" for name, count, _ in seen if count > 1]
    findings += [
        f"partial: Gram row of {name}"
        for name, count, n in seen
        if name in committed and n != count * committed[name].rows
    ]
    missing = {n for n in needed if committed[n].rows} - {name for name, _, _ in seen}
    findings += [f"unseen: Gram row of {name}" for name in sorted(missing)]
    return findings


def may_be_missing(drive: Drive, erased: str) -> bool:
    """Return True if a command erases the drive."""
    by_car = erased in ("car", "both") and drive.vehicle_id == CAR
    return by_car or (erased in ("day", "both") and drive.day == str(FIRST_DAY))


def forgotten_findings(root: str, unsaid: bool) -> list[str]:
    """Return where the forgotten car still is, although `forget --now` has returned.

    In files that no reader sees it may be, unless `unsaid`, if it has said so.
    """
    warehouse = warehouse_at(root)
    findings = []
    for table in warehouse.tables:
        active = {file.path for file in table.snapshot().files}
        for file in table.folder.files():
            if "/_delta_log/" in f"/{file.path}" or not file.path.endswith(".parquet"):
                continue
            where = "readable" if file.path in active else "unsaid"
            if (where == "readable" or unsaid) and _has_car(table, file.path):
                findings.append(f"{where}: {table.folder.name} has rows of the forgotten car")
    registry = Registry(warehouse.root, CATALOG)
    marked = marked_models(warehouse)
    for name in registry.names():
        for number in registry.versions(name):
            version = registry.load(name, number)
            trained_on_car = version.manifest.trained_on.rows % ROWS != 0
            if trained_on_car and version.reference not in marked:
                findings.append("unmarked: a version that was trained on the forgotten car")
    return findings


def _has_car(table: Table, path: str) -> bool:
    with contextlib.suppress(FleetSlipError):
        return CAR in table.read(path, ["vehicle_id"])["vehicle_id"].unique().to_pylist()
    return False


def version_findings(root: str) -> list[str]:
    """Return the versions that do not follow from the Gram rows that they name."""
    warehouse = warehouse_at(root)
    registry = Registry(warehouse.root, CATALOG)
    findings = []
    for name in registry.names():
        for number in registry.versions(name):
            version = registry.load(name, number)
            try:
                rows = _trained_on(warehouse, version)
            except FleetSlipError:
                continue  # its files are gone, as they must be after a while
            if problem := _problem(version, rows):
                findings.append(f"other bits: a version {problem}")
    return findings


def _trained_on(warehouse: Warehouse, version: ModelVersion) -> list[Mapping[str, Any]]:
    trained = version.manifest.trained_on
    active = {file.path for file in warehouse.logs.snapshot(trained.logs_version).files}
    grams = warehouse.grams.snapshot(trained.grams_version)
    rows = [row for file in grams.files for row in grams.table.read(file.path).to_pylist()]
    return [
        row
        for row in rows
        if row["vehicle_model"] == "van"
        and row["feature_set"] == trained.feature_set
        and row["file"] in active
    ]


def _problem(version: ModelVersion, rows: Sequence[Mapping[str, Any]]) -> str | None:
    manifest = version.manifest
    counts = Counter(row["drive_id"] for row in rows)
    if counts and max(counts.values()) > 1:
        return "was trained on a drive twice"
    if len(counts) != manifest.trained_on.drives:
        return f"was trained on {manifest.trained_on.drives} drives and names {len(counts)}"
    grams = [
        Gram(tuple(r["signals"].split(",")), r["n"], tuple(r["sums"]), tuple(r["products"]))
        for r in rows
    ]
    total = sum(grams, Gram.zero(grams[0].signals))
    model = fit(total, manifest.signals, manifest.label.signal).model
    per_count = Fraction(str(manifest.label.scale))
    expected = [
        coefficient * per_count / Fraction(str(term.scale))
        for term, coefficient in zip(manifest.terms, model.coefficients, strict=True)
    ]
    same = [term.coefficient_exact for term in manifest.terms] == expected
    return None if same else "has other coefficients than its Gram rows"
