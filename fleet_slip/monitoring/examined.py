"""Which drives of a cohort are to train: those that were examined, and are in order.

A cohort is examined once: what was found is kept in the user's cache, as hashes of drives, as long
as logs, Gram rows and thresholds are what they were. Simulated drives are not examined: what is
wrong in them is meant.
"""

import json
import os
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from fleet_slip.canonical import canonical_json
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.sources import RECEIVED
from fleet_slip.errors import DataError, NotComputedError
from fleet_slip.grams.cohorts.reader import GramReader
from fleet_slip.ingest.drives.measured_drives import SOURCE
from fleet_slip.ingest.landing.known_files import cache_folder
from fleet_slip.monitoring.quality import examine_drives
from fleet_slip.monitoring.thresholds import thresholds
from fleet_slip.runs.nights import hash_drive, without_drives
from fleet_slip.warehouse.condition import Condition, asking, parse_condition
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

NAME = "drive"
"""Stands for a model's name in the hashes of drives."""

MOST_DRIVES = 200_000
"""That are examined on the way to something else: it takes some 10 s and 600 MiB for 100,000."""


@dataclass(frozen=True)
class Examined:
    """What was found.

    Attributes:
        cohort: the condition without the drives that are not in order.
        drives: how many were long enough to be examined.
        faults: how many drives have each fault, such as `reversed sideslip`.
        unexamined: how many were not examined, since they are too many.
        why_not: why none was examined, although some are measured.
    """

    cohort: str
    drives: int = 0
    faults: Mapping[str, int] = field(default_factory=dict)
    unexamined: int = 0
    why_not: str = ""

    def __str__(self) -> str:
        """Return what is left out as a sentence; nothing if all are in order."""
        if self.unexamined:
            return (
                f"{self.unexamined:,} drives were not examined: more than {MOST_DRIVES:,} take too "
                "long. A night examines what is new; of a part of them: fleet-slip quality --cohort"
            )
        if self.why_not:
            return f"drives were not examined: {self.why_not}"
        if not self.faults:
            return ""
        told = ", ".join(f"{number:,} {fault}" for fault, number in self.faults.items())
        out = number_of(sum(self.faults.values()), "drive")
        return (
            f"{out} of {self.drives:,} left out, not in order: {told}. See fleet-slip quality; "
            "--unexamined takes them all the same."
        )


def leave_out_faulty(warehouse: Warehouse, cohort: str) -> Examined:
    """Examine the drives of a cohort like `quality`; return it without those not in order.

    Raises what `examine_drives` raises; where no drive is measured there is nothing to examine,
    and more than `MOST_DRIVES` are not examined.
    """
    kept = _cache(warehouse, cohort)
    with suppress(OSError, ValueError, KeyError, TypeError):
        known = json.loads(kept.read_bytes())
        return Examined(
            without_drives(cohort, NAME, map(str, known["drives"])),
            int(known["examined"]),
            {str(fault): int(number) for fault, number in known["faults"].items()},
        )
    measured = parse_condition(f"source IN ('{SOURCE}', '{RECEIVED}')")
    condition = parse_condition(cohort) & measured
    try:
        if (many := _count_drives(warehouse, condition)) > MOST_DRIVES:
            return Examined(cohort, unexamined=many)
        report = examine_drives(warehouse, condition)
    except NotComputedError as error:
        return Examined(cohort, why_not=str(error))
    except DataError:
        if not _has_drives(warehouse, condition):
            return Examined(cohort)
        return Examined(cohort, why_not="their Gram rows are not there. Run: fleet-slip gram")
    hashes = sorted(hash_drive(NAME, one.drive_id) for one in report.findings)
    faults = Counter(" ".join((one.fault.kind, *one.fault.signals)) for one in report.findings)
    content = {"drives": hashes, "examined": report.drives, "faults": faults}
    with suppress(OSError):
        kept.parent.mkdir(parents=True, exist_ok=True)
        draft = kept.with_suffix(f".{os.getpid()}")
        draft.write_text(json.dumps(content))
        draft.replace(kept)
    return Examined(without_drives(cohort, NAME, hashes), report.drives, dict(faults))


def _has_drives(warehouse: Warehouse, condition: Condition) -> bool:
    """Whether the logs have a drive that satisfies a condition."""
    query = f"SELECT 1 FROM drives WHERE {condition.sql} LIMIT 1"
    with connect_tables(warehouse, query) as database, asking(database, condition):
        return bool(database.execute(query).fetchall())


def _count_drives(warehouse: Warehouse, condition: Condition) -> int:
    """Return how many drives satisfy a condition if they can be many, else 0."""
    if warehouse.grams.snapshot().rows <= MOST_DRIVES:
        return 0
    with GramReader(warehouse) as reader:
        opened = reader.opened(PLAIN, condition)
        cohort = opened.statement("cohort.sql", condition)
        with asking(opened.database, condition):
            (many,) = opened.database.sql(f"SELECT count(*) FROM ({cohort}\n)").fetchall()[0]
    return int(many)


def _cache(warehouse: Warehouse, cohort: str) -> Path:
    """Return the file for what was found of a cohort, in the tables as they are now."""
    moments = []
    for table in (warehouse.logs, warehouse.grams):
        snapshot = table.snapshot()
        version = snapshot.version
        moments.append([version, None if version is None else snapshot.moment(version)])
    limits = thresholds().quality.model_dump(mode="json")
    about = {"root": warehouse.root.uri, "cohort": cohort, "tables": moments, "limits": limits}
    return (
        cache_folder("examined") / f"{sha256(canonical_json(about).encode()).hexdigest()[:32]}.json"
    )
