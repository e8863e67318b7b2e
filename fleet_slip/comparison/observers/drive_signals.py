"""What an estimator may read of one drive, in SI units at 100 Hz, and what its wheels tell.

Dead reckoning by wheel speeds: Carlson, Gerdes and Powell, "Error sources when land vehicle dead
reckoning with differential wheelspeeds", Navigation 51 (2004): the axle without drive torque rolls
with the least slip.
"""

from dataclasses import dataclass, fields, replace

import duckdb
import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.vehicle.parameters import VehicleParameters
from fleet_slip.warehouse.database import reading_files

STEP_S = float(SAMPLE_TIME_S)
"""Time Δt between two rows."""


@dataclass(frozen=True)
class DriveSignals:
    """One drive in float64, axes as in docs/conventions.md; NaN where nothing was measured."""

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
    car: VehicleParameters | None = None
    """The car as filters know it; None where it is that of all drives."""

    def beginning(self, rows: int) -> "LabelledDrive":
        """Return its first rows."""
        arrays = {name: values[:rows] for name, values in vars(self.signals).items()}
        return replace(self, signals=DriveSignals(**arrays), sideslip_rad=self.sideslip_rad[:rows])


def read_drive(database: duckdb.DuckDBPyConnection, drive_id: str) -> LabelledDrive:
    """Read a drive from the view `log`. Raises `QuestionError` if there is no such drive."""
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
    """Return a signal, gaps filled by the last value. Raises `DataError` without any value."""
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


@dataclass(frozen=True)
class AxleSpeeds:
    """Rolling velocity of the two wheels of one axle over cos δ, and their distance."""

    left_mps: FloatArray
    right_mps: FloatArray
    track_m: FloatArray | float
    turned_m: FloatArray | float = 0.0
    """Mean of tan δ times the axle's distance before the centre of gravity."""

    @property
    def vx_mps(self) -> FloatArray:
        """Longitudinal velocity of the centre of gravity."""
        return (self.left_mps + self.right_mps) / 2 - self.turned_m * self.yaw_rate_rad_s

    @property
    def yaw_rate_rad_s(self) -> FloatArray:
        """Yaw rate of the line through the wheels."""
        return (self.right_mps - self.left_mps) / self.track_m


def undriven_axle(drive: DriveSignals, car: VehicleParameters) -> AxleSpeeds:
    """Return the speeds of the axle that takes the smaller share of the drive torque.

    A wheel that rolls without slip at a hub with velocity (vx ∓ t/2 r, vy + a r), steered by δ, has

        R ω / cos δ = vx ∓ t/2 r + tan δ (vy + a r).

    At the rear δ = 0. At the front the wheels travel with the yaw of the car, too: tan δ a r is
    taken off their mean. tan δ vy, a thousandth of vx, is neglected.
    """
    radius, front = car.tyre.rolling_radius_m, car.body.front_axle_m
    if car.drivetrain.front_drive_share >= 0.5:
        return AxleSpeeds(
            radius * drive.wheel_rl_rad_s, radius * drive.wheel_rr_rad_s, car.body.track_rear_m
        )
    left, right = np.tan(drive.steer_fl_rad), np.tan(drive.steer_fr_rad)
    return AxleSpeeds(
        radius * drive.wheel_fl_rad_s / np.cos(drive.steer_fl_rad),
        radius * drive.wheel_fr_rad_s / np.cos(drive.steer_fr_rad),
        car.body.track_front_m + front * (right - left),
        front * (left + right) / 2,
    )


SLOWEST_MPS = 1.0
"""Longitudinal velocity below which the angle is taken as if the car drove so fast."""


def sideslip_angle(vx_mps: FloatArray, vy_mps: FloatArray) -> FloatArray:
    """Return β = arctan(vy / vx) in rad, equations (12) and (13).

    At rest the quotient has no limit and noise would turn the angle by up to π. Below
    `SLOWEST_MPS`, and in reverse, vx is therefore replaced by `SLOWEST_MPS`: β stays continuous and
    goes to zero with vy. NaN stays NaN.
    """
    return np.arctan2(vy_mps, np.maximum(vx_mps, SLOWEST_MPS))
