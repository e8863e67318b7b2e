"""Drives many cars at once: each drive is a lane of a loop that the compiler vectorises."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from fleet_slip.vehicle.parameters import VehicleParameters


class Road(NamedTuple):
    """The line to follow and the speed to hold, tabulated at equal steps of the station.

    The first entry stands at station 0. A closed road is periodic: `length_m` is a whole number of
    spacings, and the entry after the last is the first again.
    """

    spacing_m: float
    curvature_1pm: NDArray[np.float64]
    """Curvature of the line, (m,), positive to the left."""
    speed_mps: NDArray[np.float64]
    """Target speed, (m,), already times the speed factor."""
    length_m: float
    closed: bool


@dataclass(frozen=True)
class LaneDrive:
    """One drive to simulate. It starts at station 0, on the line, at the road's target speed."""

    vehicle: VehicleParameters
    road: Road
    adhesion: float
    """Adhesion coefficient μ of the road, 1 on dry asphalt."""
    laps: float
    """Length of the drive in lengths of the road."""


@dataclass(frozen=True)
class Truth:
    """What happened in one drive, at 100 Hz: float64 arrays of one length, signs after ISO 8855."""

    ax_mps2: NDArray[np.float64]
    """Longitudinal specific force at the centre of gravity."""
    ay_mps2: NDArray[np.float64]
    """Lateral specific force at the centre of gravity."""
    yaw_rate_rad_s: NDArray[np.float64]
    steering_wheel_rad: NDArray[np.float64]
    wheel_fl_rad_s: NDArray[np.float64]
    wheel_fr_rad_s: NDArray[np.float64]
    wheel_rl_rad_s: NDArray[np.float64]
    wheel_rr_rad_s: NDArray[np.float64]
    steer_fl_rad: NDArray[np.float64]
    steer_fr_rad: NDArray[np.float64]
    sideslip_rad: NDArray[np.float64]
    vx_mps: NDArray[np.float64]
    vy_mps: NDArray[np.float64]
    station_m: NDArray[np.float64]
    """Distance along the road within the lap."""
    lateral_offset_m: NDArray[np.float64]
    lost_control_tick: int | None
    """First tick at which the driver had lost the car; None where he never did."""
