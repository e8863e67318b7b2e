"""Which drives of a cohort may train a model: those that were examined and are in order.

Drives are examined once: what was found is kept in the user's cache, as hashes of drives, as long
as Gram rows and thresholds are what they were. Many drives are examined in pieces of whole days, so
that a night costs its own piece. Simulated drives are not examined: what is wrong in them is meant.
"""

import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import date
from hashlib import sha256
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.canonical import canonical_json
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.sources import RECEIVED
from fleet_slip.delta import Snapshot, TableFile
from fleet_slip.grams.cohorts.folding import EACH, Folding
from fleet_slip.grams.cohorts.gram_reader import GramReader
from fleet_slip.grams.rows.backlog import find_backlog
from fleet_slip.grams.rows.rollup import hash_numbers
from fleet_slip.ingest.drives.measured_drives import SOURCE
from fleet_slip.ingest.landing.known_files import cache_folder
from fleet_slip.monitoring.quality import examine_drives
from fleet_slip.monitoring.thresholds import thresholds
from fleet_slip.runs.nights import hash_drive, without_drives
from fleet_slip.warehouse.condition import Condition, asking, parse_condition
from fleet_slip.warehouse.table_views import gram_snapshots, lock, open_tables, views_in
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

NAME = "drive"
"""Stands for a model's name in the hashes of drives."""

PIECE = 100_000
"""Drives that are compared with one another, or a quarter more: some 10 s and 600 MiB."""


@dataclass(frozen=True)
class Examined:
    """What was found.

    Attributes:
        cohort: the condition without the drives that are not in order.
        drives: how many were long enough to be examined.
        faults: how many drives have each fault, such as `reversed sideslip`.
        missing: how many measured drives were not, since they have no Gram rows.
        missing_rows: how many rows of the logs are to be read for these.
    """

    cohort: str
    drives: int = 0
    faults: Mapping[str, int] = field(default_factory=dict)
    missing: int = 0
    missing_rows: int = 0

    @property
    def lacking(self) -> str:
        """What was not examined and what to do, as a sentence; nothing if all were examined."""
        if not self.missing:
            return ""
        return (
            f"{number_of(self.missing, 'measured drive')} not examined: the Gram rows of their "
            "signals are not there. Run: fleet-slip gram"
        )

    def __str__(self) -> str:
        """Return what is left out, and what was not examined; nothing if all are in order."""
        if not self.faults:
            return self.lacking
        told = ", ".join(f"{number:,} {fault}" for fault, number in self.faults.items())
        out = number_of(sum(self.faults.values()), "drive")
        left_out = (
            f"{out} of {self.drives:,} left out, not in order: {told}. See fleet-slip quality; "
            "--unexamined takes them all the same."
        )
        return f"{left_out} {self.lacking}".strip()


@dataclass(frozen=True)
class _Piece:
    """Days whose drives are examined together; `rows` are hashes of their Gram rows."""

    days: tuple[date, ...]
    drives: int
    rows: tuple[int, ...]

    def __add__(self, other: "_Piece") -> "_Piece":
        return _Piece(self.days + other.days, self.drives + other.drives, self.rows + other.rows)

    @property
    def condition(self) -> Condition:
        return parse_condition(f"day BETWEEN DATE '{self.days[0]}' AND DATE '{self.days[-1]}'")


def leave_out_faulty(warehouse: Warehouse, cohort: str) -> Examined:
    """Examine the drives of a cohort like `quality`; return it without those not in order.

    Drives without Gram rows of `signals` are not examined, and counted. Raises what
    `examine_drives` raises; where no drive is measured there is nothing to examine.
    """
    measured = parse_condition(f"source IN ('{SOURCE}', '{RECEIVED}')")
    condition = parse_condition(cohort) & measured
    grams, logs = gram_snapshots(warehouse)
    missing, missing_rows = _lacking(warehouse, grams, logs, condition)
    found: list[Mapping[str, Any]] = []
    for piece in _pieces(warehouse, condition) if grams.rows else []:
        about = {"cohort": cohort, "from": piece.days[0], "root": warehouse.root.uri}
        limits = thresholds().quality.model_dump(mode="json")
        state = [list(piece.rows), sha256(canonical_json(limits).encode()).hexdigest()]
        name = sha256(canonical_json({k: str(v) for k, v in about.items()}).encode()).hexdigest()
        kept = cache_folder("examined") / f"{name[:32]}.json"
        found.append(_known(kept, state) or _examine(warehouse, condition & piece.condition))
        _keep(kept, {**found[-1], "state": state})
    hashes = {name for one in found for name in one["drives"]}
    faults = sum((Counter(one["faults"]) for one in found), Counter[str]())
    examined = sum(one["examined"] for one in found)
    kept_cohort = without_drives(cohort, NAME, hashes)
    return Examined(kept_cohort, examined, dict(faults), missing, missing_rows)


def _examine(warehouse: Warehouse, condition: Condition) -> Mapping[str, Any]:
    report = examine_drives(warehouse, condition)
    hashes = sorted(hash_drive(NAME, one.drive_id) for one in report.findings)
    faults = Counter(" ".join((one.fault.kind, *one.fault.signals)) for one in report.findings)
    return {"drives": hashes, "examined": report.drives, "faults": faults}


def _known(kept: Path, state: list[Any]) -> Mapping[str, Any] | None:
    with suppress(OSError, ValueError, KeyError, TypeError):
        known = json.loads(kept.read_bytes())
        if known["state"] == state:
            return {
                "drives": [str(one) for one in known["drives"]],
                "examined": int(known["examined"]),
                "faults": {str(fault): int(many) for fault, many in known["faults"].items()},
            }
    return None


def _keep(kept: Path, content: Mapping[str, Any]) -> None:
    with suppress(OSError):
        kept.parent.mkdir(parents=True, exist_ok=True)
        draft = kept.with_suffix(f".{os.getpid()}")
        draft.write_text(json.dumps(content))
        draft.replace(kept)


def _pieces(warehouse: Warehouse, condition: Condition) -> list[_Piece]:
    """Divide a cohort's days, so that new days change the last piece alone.

    Gram files whose rollups serve are told by their names, which have the checksum of their rows.
    """
    with GramReader(warehouse) as reader:
        opened = reader.opened(PLAIN, condition, Folding(by="day", count=EACH))
        statement = opened.statement("examined_days.sql", condition)
        with asking(opened.database, condition):
            found = opened.database.execute(statement).fetchall()
    days = {day: (drives, (rows,)) for day, drives, rows in found}
    for (day,), cells in opened.cells.by("day"):
        drives, rows = days.get(day, (0, ()))
        paths = sorted(opened.cells.rollups[i].path for i in cells["rollup"].unique().to_pylist())
        names = hash_numbers(pa.array(paths)).tolist()
        days[day] = (drives + pc.sum(cells["gram_rows"]).as_py(), (*rows, *names))
    pieces: list[_Piece] = []
    for day in (_Piece((day,), *days[day]) for day in sorted(days) if days[day][0]):
        if pieces and pieces[-1].drives < PIECE:
            pieces[-1] += day
        else:
            pieces.append(day)
    if len(pieces) > 1 and 4 * pieces[-1].drives < PIECE:
        pieces[-2:] = [pieces[-2] + pieces[-1]]
    return pieces


def _lacking(
    warehouse: Warehouse, grams: Snapshot, logs: Snapshot, condition: Condition
) -> tuple[int, int]:
    """Return how many drives of a cohort's logs lack Gram rows, and the rows to read for them."""
    missing = find_backlog(logs, grams).missing
    if not missing:
        return 0, 0
    query = f"SELECT count(*) FROM drives WHERE {condition.sql} AND source <> '{RECEIVED}'"
    others = frozenset(_paths(logs.files)) - frozenset(_paths(missing))
    only = [grams, replace(logs, without=others)]
    with open_tables(warehouse, views_in(query), only) as database:
        lock(database, [path for one in only for path in one.paths])
        with asking(database, condition):
            [(drives,)] = database.execute(query).fetchall()
    return int(drives), sum(file.rows for file in missing)


def _paths(files: Iterable[TableFile]) -> list[str]:
    return [file.path for file in files]
