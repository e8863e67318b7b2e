"""Where the car is on its road: station along the line, offset from it, heading against it.

In these curvilinear coordinates (Serret-Frenet) no nearest point has to be searched, and with the
heading as a unit vector no angle has to be taken.
"""

from typing import NamedTuple

from fleet_slip.compiling import equation
from fleet_slip.vehicle.integration import extrapolate
from fleet_slip.vehicle.state import State

LEAST_RADIUS_SHARE = 0.2
"""The station stops short of the centre of a bend's curvature, where it is not defined."""


class Pose(NamedTuple):
    """Place and heading relative to the road's line."""

    station: float
    """Along the line, in m."""
    offset: float
    """From the line to the left, in m."""
    cosine: float
    """Of the car's heading against the line's."""
    sine: float


class Path(NamedTuple):
    """The road as it was looked up at the last sample."""

    station: float
    """Where it was looked up."""
    curvature: float
    curvature_slope: float
    """Per metre: within a sample curvature is linear in the station."""
    curvature_ahead: float
    target_speed: float
    target_acceleration: float
    lost: float
    """1 once the driver has lost the car, else 0."""


class PoseSlopes(NamedTuple):
    """Rates of the pose."""

    station: float
    offset: float
    cosine: float
    sine: float


@equation
def pose_slopes(x: State, pose: Pose, path: Path) -> PoseSlopes:
    """Return ṡ = (vx cos ψ − vy sin ψ) / (1 − κ e), ė = vx sin ψ + vy cos ψ, and ψ̇ = r − κ ṡ.

    The heading's rate turns its unit vector.
    """
    curvature = path.curvature + path.curvature_slope * (pose.station - path.station)
    shrink = max(1.0 - curvature * pose.offset, LEAST_RADIUS_SHARE)
    station = (x.vx * pose.cosine - x.vy * pose.sine) / shrink
    turning = x.yaw_rate - curvature * station
    return PoseSlopes(
        station,
        x.vx * pose.sine + x.vy * pose.cosine,
        -turning * pose.sine,
        turning * pose.cosine,
    )


@equation
def advance_pose(
    pose: Pose, d: PoseSlopes, before: PoseSlopes, step: float, extrapolation: float
) -> Pose:
    """Return the pose after a step of Adams-Bashforth, its unit vector of length 1 again."""
    cosine = pose.cosine + step * extrapolate(d.cosine, before.cosine, extrapolation)
    sine = pose.sine + step * extrapolate(d.sine, before.sine, extrapolation)
    # One Newton iteration for 1/√n from 1: the length is 1 to a few parts in a million before.
    scale = 1.5 - 0.5 * (cosine * cosine + sine * sine)
    return Pose(
        pose.station + step * extrapolate(d.station, before.station, extrapolation),
        pose.offset + step * extrapolate(d.offset, before.offset, extrapolation),
        cosine * scale,
        sine * scale,
    )
