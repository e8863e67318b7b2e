"""Which drives of a cohort a version was trained on, and those that it was not."""

from dataclasses import dataclass

from fleet_slip.catalogue.sources import RECEIVED
from fleet_slip.grams.rows.gram_rows import hash_numbers
from fleet_slip.models.estimates.score import cohort_of_rows
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.versions import Registry
from fleet_slip.warehouse.condition import Condition, asking, drive_columns
from fleet_slip.warehouse.database import sql_text
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True)
class SeenDrives:
    """A cohort's drives, those that made a version (None: not kept), the condition of others."""

    drives: int
    trained: int | None
    others: Condition


def find_seen(
    warehouse: Warehouse, registry: Registry, manifest: Manifest, condition: str | Condition
) -> SeenDrives:
    """Return which drives with a log of a cohort of rows made a version. Raises as `score`."""
    cohort = cohort_of_rows(condition)
    view = "log" if cohort.columns - set(drive_columns()) else "drives"
    logged = f"({cohort.sql}) AND source <> '{RECEIVED}'"
    query = f"SELECT DISTINCT drive_id FROM {view} WHERE {logged} ORDER BY 1"
    with connect_tables(warehouse, query) as database, asking(database, cohort):
        names = database.sql(query).to_arrow_table()["drive_id"]
    made = registry.trained_drives(manifest)
    if made is None:
        return SeenDrives(len(names), None, cohort)
    seen = made.among(hash_numbers(names))
    if not seen.any() or seen.all():
        return SeenDrives(len(names), int(seen.sum()), cohort)
    kept = [name for name, old in zip(names.to_pylist(), seen, strict=True) if not old]
    listed = ", ".join(map(sql_text, kept))
    others = Condition(cohort.text, f"({cohort.sql} AND drive_id IN ({listed}))")
    return SeenDrives(len(names), int(seen.sum()), others)
