"""Forgets drives by what their owner calls them, or by the file that they came in."""

from collections.abc import Iterator
from typing import Literal, TypeAlias

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.errors import QuestionError
from fleet_slip.maintenance.forget import ForgetReport, forget
from fleet_slip.maintenance.old_files import read_old_files
from fleet_slip.progress import Progress, no_progress
from fleet_slip.views import connect
from fleet_slip.warehouse.audit import Forgettable
from fleet_slip.warehouse.tables import Warehouse

Calling: TypeAlias = Literal["drive_name", "source_file"]
"""A column of `drives` by which people know a drive; several drives may have the same."""


def forget_called(
    warehouse: Warehouse,
    calling: Calling,
    value: str,
    *,
    now: bool = False,
    progress: Progress = no_progress,
) -> ForgetReport:
    """Forget every drive that is called like that, one after another.

    Drives that come later under the same name are others, and land. Repeated after an interruption
    it goes on: what is left of a drive still tells its name. Raises `QuestionError` if no drive is
    called like that, and what `forget` raises.
    """
    drives = sorted(_drives_called(warehouse, calling, value, old=now))
    if not drives:
        raise QuestionError(
            f"no drive has {calling} {value!r}. See: "
            f'fleet-slip sql "SELECT drive_id, {calling} FROM drives"'
        )
    reports = []
    for drive in drives:
        reports.append(forget(warehouse, Forgettable("drive", drive), now=now))
        progress(1, len(drives))
    return _together(reports)


def _drives_called(
    warehouse: Warehouse, calling: Calling, value: str, *, old: bool
) -> frozenset[str]:
    """Return the drives in logs and Gram rows, and in old files too if these are to go."""
    with connect(warehouse.root, query="drives") as database:
        statement = f"SELECT DISTINCT drive_id FROM drives WHERE {calling} = $value"
        found = {name for (name,) in database.execute(statement, {"value": value}).fetchall()}
    for rows in _named_rows(warehouse, calling, old=old):
        if calling in rows.column_names:
            mine = pc.equal(rows[calling].cast(pa.string()), value)
            found.update(rows["drive_id"].filter(mine).cast(pa.string()).unique().to_pylist())
    return frozenset(found)


def _named_rows(warehouse: Warehouse, calling: Calling, *, old: bool) -> Iterator[pa.Table]:
    grams = warehouse.grams
    for file in grams.snapshot().files:
        if calling in grams.read_metadata(file.path).schema.to_arrow_schema().names:
            yield grams.read(file.path, ["drive_id", calling])
    if old:
        for table in (warehouse.logs, warehouse.grams):
            yield from (one.rows for one in read_old_files(table.snapshot()))


def _together(reports: list[ForgetReport]) -> ForgetReport:
    """Return one report of all; what may still have the rows of any of the drives is pending."""
    return ForgetReport(
        drives=sum(one.drives for one in reports),
        rows=sum(one.rows for one in reports),
        files_rewritten=sum(one.files_rewritten for one in reports),
        files_removed=sum(one.files_removed for one in reports),
        models=tuple(sorted({name for one in reports for name in one.models})),
        old_files_deleted=sum(one.old_files_deleted for one in reports),
        old_files_left=max(one.old_files_left for one in reports),
        pending=tuple(dict.fromkeys(name for one in reports for name in one.pending)),
    )
