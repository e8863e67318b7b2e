"""Where everything stands that a lane carries, and how a drive enters and leaves a lane."""

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.vehicle.car_imperfections import Traits
from fleet_slip.vehicle.driver import Handling
from fleet_slip.vehicle.imperfect_dynamics import Around, Give, GiveRates
from fleet_slip.vehicle.integration import Slopes
from fleet_slip.vehicle.lanes.rows import LANES
from fleet_slip.vehicle.parameters import Constants
from fleet_slip.vehicle.pose import Path, Pose, PoseSlopes
from fleet_slip.vehicle.state import Controls, State

NOBODY = -1
"""Drive of a lane that has none, and tick of a loss that has not happened."""

DRIVE, TICK, LAP, FIRST = range(4)
"""Rows of the book of lanes: which drive a lane carries, its next sample, its lap, and the tick of
the first sample of its block."""

STATE = 0
"""First row of a named tuple in the memory; the next follow."""
SLOPES = STATE + len(State._fields)
POSE = SLOPES + len(Slopes._fields)
POSE_SLOPES = POSE + len(Pose._fields)
CONTROLS = POSE_SLOPES + len(PoseSlopes._fields)
PATH = CONTROLS + len(Controls._fields)
FORCE = PATH + len(Path._fields)
"""Specific force ax, ay at the sample."""
ORDER = FORCE + 2
"""Extrapolation of the integration: 0 in a drive's first step."""
CAR = ORDER + 1
HANDLING = CAR + len(Constants._fields)
TRAITS = HANDLING + len(Handling._fields)
"""From here on only cars with imperfections use the memory."""
AROUND = TRAITS + len(Traits._fields)
GIVE = AROUND + len(Around._fields)
GIVE_SLOPES = GIVE + len(Give._fields)
ROWS = GIVE_SLOPES + len(GiveRates._fields)

STEER = Constants._fields.index("steer_per_wheel")
ACKERMANN = Constants._fields.index("ackermann")
INVERSE_RADIUS = Constants._fields.index("inverse_radius")


def empty_lanes() -> tuple[FloatArray, IntArray]:
    """Return the memory and the book of lanes without a drive: cars at rest."""
    return np.zeros(ROWS * LANES), np.full((4, LANES), NOBODY)


def begin(
    memory: FloatArray,
    book: IntArray,
    lane: int,
    drive: int,
    car: FloatArray,
    speed_mps: float,
) -> None:
    """Put a drive on a lane: rolling straight along the line at a speed, on cold tyres."""
    book[:, lane] = drive, 0, 0, 0
    spin = speed_mps * car[INVERSE_RADIUS]
    column = memory.reshape(ROWS, LANES)[:, lane]
    column[:] = 0.0
    column[CAR : CAR + len(car)] = car
    column[STATE : STATE + len(State._fields)] = State(speed_mps, *6 * (0.0,), *4 * (spin,))
    column[POSE : POSE + len(Pose._fields)] = Pose(0.0, 0.0, 1.0, 0.0)
    cold = column[TRAITS + Traits._fields.index("cold_stiffness")]
    column[AROUND : AROUND + len(Around._fields)] = Around(0.0, 0.0, 1.0, 1.0, 0.0, 1.0 + cold)


def clear(memory: FloatArray, book: IntArray, lane: int) -> None:
    """Let nothing stand on a lane: a car at rest."""
    book[DRIVE, lane] = NOBODY
    memory.reshape(ROWS, LANES)[:, lane] = 0.0
