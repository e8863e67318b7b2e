"""Turns small log files of a day into large ones.

Gram rows of new files are computed, and land before them; reconciliation drops the old.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date

from fleet_slip.delta import TableFile, retry_conflicts
from fleet_slip.grams.rows.gram_job import reconcile
from fleet_slip.maintenance.rewriting import Rewriting, rewrite
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.tables import Warehouse

TARGET_ROWS = 2_000_000
"""Rows of a compacted file or fewer. A file of more than half of it is left alone."""


@dataclass(frozen=True)
class CompactionReport:
    """What a run of the job did."""

    days: int
    files_before: int
    files_after: int
    rows_rewritten: int
    size_bytes_before: int
    size_bytes_after: int
    logs_version: int | None

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        return bool(self.rows_rewritten)


def compact(
    warehouse: Warehouse,
    target_rows: int = TARGET_ROWS,
    progress: Progress = no_progress,
) -> CompactionReport:
    """Compact each day in a commit, then reconcile Gram rows. Raises `ConflictError`."""
    warehouse.require()
    before = warehouse.logs.snapshot()
    days = sorted({file.day for file in before.files if file.day is not None})
    rewritten = 0
    for day in days:
        rewritten += _compact_day(warehouse, day, target_rows)
        progress(1, len(days))
    reconcile(warehouse)
    after = warehouse.logs.snapshot()
    return CompactionReport(
        days=len(days),
        files_before=len(before.files),
        files_after=len(after.files),
        rows_rewritten=rewritten,
        size_bytes_before=before.size_bytes,
        size_bytes_after=after.size_bytes,
        logs_version=after.version,
    )


def _compact_day(warehouse: Warehouse, day: date, target_rows: int) -> int:
    def attempt() -> int:
        snapshot = warehouse.logs.snapshot()
        small = [f for f in snapshot.files if f.day == day and 2 * f.rows <= target_rows]
        packs = list(_packs(small, target_rows))
        if packs:
            rewrite(
                warehouse,
                snapshot,
                [Rewriting("compact", pack) for pack in packs],
                note={"job": "compact", "day": day.isoformat()},
                data_change=False,
            )
        return sum(file.rows for pack in packs for file in pack)

    return retry_conflicts(attempt)


def _packs(files: Iterable[TableFile], target_rows: int) -> Iterable[list[TableFile]]:
    """Yield runs of two files or more that fit together; only the last may be packed again."""
    pack: list[TableFile] = []
    for file in files:
        if pack and sum(f.rows for f in pack) + file.rows > target_rows:
            if len(pack) > 1:
                yield pack
            pack = []
        pack.append(file)
    if len(pack) > 1:
        yield pack
