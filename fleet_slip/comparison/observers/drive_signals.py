"""What an estimator may read of one drive, in SI units at 100 Hz."""

from dataclasses import dataclass, fields

import duckdb
import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.warehouse.database import reading_files

STEP_S = float(SAMPLE_TIME_S)
"""Time Δt between two rows."""


@dataclass(frozen=True)
class DriveSignals:
    """One drive: float64 arrays of one length, NaN where there is no measurement.

    Axes and signs are those of docs/conventions.md. GPS has its own rate and is NaN between fixes.
    """

    ax_mps2: FloatArray
    ay_mps2: FloatArray
    yaw_rate_rad_s: FloatArray
    wheel_fl_rad_s: FloatArray
    wheel_fr_rad_s: FloatArray
    wheel_rl_rad_s: FloatArray
    wheel_rr_rad_s: FloatArray
    steer_fl_rad: FloatArray
    steer_fr_rad: FloatArray
    gps_vx_mps: FloatArray
    gps_vy_mps: FloatArray

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.ax_mps2)


@dataclass(frozen=True)
class LabelledDrive:
    """A drive with its true side-slip, for evaluation and tuning; no estimator sees it."""

    drive_id: str
    signals: DriveSignals
    sideslip_rad: FloatArray


def read_drive(database: duckdb.DuckDBPyConnection, drive_id: str) -> LabelledDrive:
    """Read a drive from the view `log` of a warehouse (`fleet_slip.views.connect`).

    Raises `QuestionError` if there is no such drive.
    """
    label = catalogue()[catalogue().label].column
    columns = [*(field.name for field in fields(DriveSignals)), label]
    with reading_files(database, f"reading the drive {drive_id!r}"):
        found = database.execute(
            f"SELECT {', '.join(columns)} FROM log WHERE drive_id = $drive_id ORDER BY time_s",
            {"drive_id": drive_id},
        ).fetchnumpy()
    if not len(found[label]):
        raise QuestionError(f"no drive is called {drive_id!r}. The view drives lists them.")
    arrays = {name: np.ma.filled(found[name].astype(np.float64), np.nan) for name in columns}
    sideslip_rad = arrays.pop(label)
    return LabelledDrive(drive_id, DriveSignals(**arrays), sideslip_rad)


def hold_last(values: FloatArray, name: str) -> FloatArray:
    """Return a signal with every gap filled by the value before it, a leading one by the first.

    Raises `DataError` if there is no value at all.
    """
    valid = np.isfinite(values)
    if valid.all():
        return values
    if not valid.any():
        raise DataError(
            f"the drive has no {name}, which this estimator needs. Choose drives that have it, or "
            "another estimator."
        )
    latest = np.maximum.accumulate(np.where(valid, np.arange(len(values)), valid.argmax()))
    return values[latest]
