"""Blocks of samples that lanes record, so that a drive of any length needs the same memory.

A block is still in the processor's cache when it is measured.
"""

from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.compiling import equation
from fleet_slip.vehicle.arctangent import arctan2
from fleet_slip.vehicle.lanes.lane_memory import ACKERMANN, STEER
from fleet_slip.vehicle.lanes.rows import LANES
from fleet_slip.vehicle.pose import Pose
from fleet_slip.vehicle.state import State

CHANNELS = (
    "ax_mps2",
    "ay_mps2",
    "yaw_rate_rad_s",
    "steering_wheel_rad",
    "wheel_fl_rad_s",
    "wheel_fr_rad_s",
    "wheel_rl_rad_s",
    "wheel_rr_rad_s",
    "steer_fl_rad",
    "steer_fr_rad",
    "sideslip_rad",
    "vx_mps",
    "vy_mps",
    "station_m",
    "lateral_offset_m",
)
"""What a lane records."""

IMPERFECT_CHANNELS = ("yaw_acceleration_rad_s2", "leaning_ax_mps2", "leaning_ay_mps2")
"""What a lane records besides of a car with imperfections, for its sensors: how the body begins to
turn, and the accelerations as its pitch and roll have followed them."""

BLOCK = 2**16
"""Samples of a block: 11 minutes of a drive."""

STRIDE = BLOCK + 8
"""Distance between two channels of a block: with a power of two all channels would share the same
few lines of the processor's cache."""

BLOCK_SHAPE = (LANES, len(CHANNELS), STRIDE)
"""Shape of the blocks of all lanes."""


IMPERFECT_BLOCK_SHAPE = (LANES, len(IMPERFECT_CHANNELS), STRIDE)


def empty_blocks(imperfect: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return memory for the blocks of all lanes, flat, and its two parts in their shapes."""
    usual = LANES * len(CHANNELS) * STRIDE
    memory = np.empty(usual + (LANES * len(IMPERFECT_CHANNELS) * STRIDE if imperfect else 0))
    more = memory[usual:].reshape(IMPERFECT_BLOCK_SHAPE if imperfect else (LANES, 0, STRIDE))
    return memory, memory[:usual].reshape(BLOCK_SHAPE), more


@equation
def at(lane: int, channel: int, sample: int) -> int:
    """Return where a sample of a channel stands in the blocks."""
    return (lane * len(CHANNELS) + channel) * STRIDE + sample


@equation
def further_at(lane: int, channel: int, sample: int) -> int:
    """Return where a sample of one of `IMPERFECT_CHANNELS` stands in the blocks."""
    start = LANES * len(CHANNELS) * STRIDE
    return start + (lane * len(IMPERFECT_CHANNELS) + channel) * STRIDE + sample


@equation
def record(truth: Any, lane: int, sample: int, x: State, pose: Pose) -> None:
    """Write the sample that begins here, but for the specific force, which the next step gives."""
    truth[at(lane, 2, sample)] = x.yaw_rate
    truth[at(lane, 3, sample)] = x.steering_wheel
    truth[at(lane, 4, sample)] = x.wheel_fl
    truth[at(lane, 5, sample)] = x.wheel_fr
    truth[at(lane, 6, sample)] = x.wheel_rl
    truth[at(lane, 7, sample)] = x.wheel_rr
    truth[at(lane, 11, sample)] = x.vx
    truth[at(lane, 12, sample)] = x.vy
    truth[at(lane, 13, sample)] = pose.station
    truth[at(lane, 14, sample)] = pose.offset


@equation
def fill_recorded_angles(left: Any, right: Any, vx: Any, vy: Any, slip: Any) -> None:
    """Fill in the angles of a block in which the wheels' tangents stand instead of their angles."""
    for tick in range(len(left)):
        left[tick] = arctan2(left[tick], 1.0)
    for tick in range(len(right)):
        right[tick] = arctan2(right[tick], 1.0)
    for tick in range(len(slip)):
        slip[tick] = arctan2(vy[tick], vx[tick])


@equation
def fill_angles(wheel: Any, left: Any, right: Any, vx: Any, vy: Any, slip: Any, car: Any) -> None:
    """Fill in the road wheels' angles and the side-slip angle of a block."""
    steer, ackermann = car[STEER], car[ACKERMANN]
    for tick in range(len(wheel)):
        tangent = steer * wheel[tick]
        left[tick] = arctan2(tangent, 1.0 - ackermann * tangent)
    for tick in range(len(wheel)):
        tangent = steer * wheel[tick]
        right[tick] = arctan2(tangent, 1.0 + ackermann * tangent)
    for tick in range(len(wheel)):
        slip[tick] = arctan2(vy[tick], vx[tick])
