"""Simulated drives as a whole, which only tests and benchmarks ask for."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.vehicle.batch import STEPS_PER_SAMPLE, LaneDrive, simulate_blocks
from fleet_slip.vehicle.batch_kernel import CHANNELS


@dataclass(frozen=True)
class Truth:
    """What happened in one drive, at 100 Hz: float64 arrays of one length, signs after ISO 8855."""

    ax_mps2: FloatArray
    """Longitudinal specific force at the centre of gravity."""
    ay_mps2: FloatArray
    """Lateral specific force at the centre of gravity."""
    yaw_rate_rad_s: FloatArray
    steering_wheel_rad: FloatArray
    wheel_fl_rad_s: FloatArray
    wheel_fr_rad_s: FloatArray
    wheel_rl_rad_s: FloatArray
    wheel_rr_rad_s: FloatArray
    steer_fl_rad: FloatArray
    steer_fr_rad: FloatArray
    sideslip_rad: FloatArray
    vx_mps: FloatArray
    vy_mps: FloatArray
    station_m: FloatArray
    """Distance along the road within the lap."""
    lateral_offset_m: FloatArray
    yaw_acceleration_rad_s2: FloatArray
    leaning_ax_mps2: FloatArray
    leaning_ay_mps2: FloatArray
    lost_control_tick: int | None
    """First tick at which the driver had lost the car; None where he never did."""


def simulate_drives(
    drives: Sequence[LaneDrive], steps_per_sample: int = STEPS_PER_SAMPLE
) -> list[Truth]:
    """Return what happens in each drive as a whole; see `simulate_blocks`."""
    parts: list[list[dict[str, FloatArray]]] = [[] for _ in drives]
    lost: dict[int, int | None] = {}
    for block in simulate_blocks(drives, steps_per_sample):
        parts[block.drive].append({name: x.copy() for name, x in block.channels.items()})
        lost[block.drive] = block.lost_control_tick
    return [
        Truth(
            **{name: np.concatenate([part[name] for part in some]) for name in CHANNELS},
            lost_control_tick=lost[drive],
        )
        for drive, some in enumerate(parts)
    ]
