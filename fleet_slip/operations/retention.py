"""How long data is kept: `configs/retention.toml`, or a file of the user's own."""

from dataclasses import dataclass
from datetime import date, timedelta

import pyarrow.compute as pc
from pydantic import Field

from fleet_slip.base import Progress, no_progress
from fleet_slip.config import Config, load_config
from fleet_slip.errors import ConfigError, RefusedError
from fleet_slip.grams.gram_files import is_of_received
from fleet_slip.operations.find_drives import RETENTION_HOURS, VacuumReport, vacuum
from fleet_slip.operations.forget import ForgetReport, forget
from fleet_slip.resources import config_file, find_config
from fleet_slip.warehouse.forgotten import Forgettable
from fleet_slip.warehouse.tables import Warehouse


class Retention(Config):
    """How long drives and replaced files are kept."""

    drives_days: int = Field(ge=1, le=36_500)
    replaced_files_hours: int = Field(ge=1, le=RETENTION_HOURS)


@dataclass(frozen=True)
class RetentionReport:
    """What was forgotten, and which files were removed."""

    before: date
    forgotten: ForgetReport
    vacuumed: VacuumReport


def load_retention(path: str | None) -> Retention:
    """Read a retention file, the one that ships unless told otherwise. Raises `ConfigError`."""
    file = config_file("retention.toml") if path is None else find_config("retention", path)
    return load_config(file, Retention)


def retain(
    warehouse: Warehouse,
    retention: Retention,
    today: date,
    progress: Progress = no_progress,
) -> RetentionReport:
    """Forget the drives that are older than retention says, then vacuum; `progress` counts files.

    Raises `RefusedError` if not one drive would be left, as with a clock that is wrong.
    """
    warehouse.require()
    try:
        before = today - timedelta(days=retention.drives_days)
    except OverflowError:
        raise ConfigError(f"drives_days = {retention.drives_days}: too long ago.") from None
    days = [file.day for file in warehouse.logs.snapshot().files if file.day is not None]
    for file in filter(is_of_received, warehouse.grams.snapshot().files):
        days.append(pc.max(warehouse.grams.read(file.path, ["day"])["day"]).as_py())
    if days and max(days) < before:
        raise RefusedError(
            f"{warehouse.root}: its latest drive is of {max(days)} and all before {before} would "
            "be forgotten, which leaves none. Check the clock, or drives_days of the retention."
        )
    forgotten = forget(warehouse, Forgettable("before", before.isoformat()), progress=progress)
    vacuumed = vacuum(warehouse, retention.replaced_files_hours)
    return RetentionReport(before, forgotten, vacuumed)
