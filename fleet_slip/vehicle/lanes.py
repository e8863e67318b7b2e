"""Drives many cars at once: each drive is a lane of a loop that the compiler vectorises."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import ConfigError
from fleet_slip.vehicle import kernel, lane_memory
from fleet_slip.vehicle.driver import SAMPLE_S, handling
from fleet_slip.vehicle.integration import STEP_S
from fleet_slip.vehicle.kernel import LOST_SPEED_MPS
from fleet_slip.vehicle.lane_blocks import BLOCK, BLOCK_SHAPE, CHANNELS
from fleet_slip.vehicle.lane_memory import DRIVE, FIRST, NOBODY
from fleet_slip.vehicle.parameters import VehicleParameters, constants

STEPS_PER_SAMPLE = round(SAMPLE_S / STEP_S)

PATIENCE = 1.25
"""A drive that takes so many times its planned time ends."""

GRACE_S = 5.0
"""Time that every drive may take beyond that."""

FARTHEST_VIEW_M = 20.0
"""How far beyond a lap's end a driver may look."""


class Road(NamedTuple):
    """The line to follow and the speed to hold, tabulated at equal steps of the station.

    The first entry stands at station 0. A closed road is periodic: `length_m` is a whole number of
    spacings, and the entry after the last is the first again.
    """

    spacing_m: float
    curvature_1pm: FloatArray
    """Curvature of the line, (m,), positive to the left."""
    speed_mps: FloatArray
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
    lost_control_tick: int | None
    """First tick at which the driver had lost the car; None where he never did."""


@dataclass(frozen=True)
class TruthBlock:
    """What happened in a part of a drive: at most `BLOCK` samples, without a gap."""

    drive: int
    """Which of the drives."""
    channels: dict[str, FloatArray]
    """The arrays of `Truth`. Their memory is used again for the next block."""
    last: bool
    """Whether the drive ends with it."""
    lost_control_tick: int | None
    """As in `Truth`, counted from the start of the drive; None in a block before the loss."""


def simulate_blocks(
    drives: Sequence[LaneDrive], steps_per_sample: int = STEPS_PER_SAMPLE
) -> Iterator[TruthBlock]:
    """Yield what happens in each drive, sampled at 100 Hz from its start, block by block.

    The blocks of a drive come in order, those of different drives in any. A drive ends after its
    laps, at the end of an open road, `kernel.AFTER_LOSS` samples after the driver lost the car, or
    when it takes `PATIENCE` times as long as planned. The bits of a drive depend on nothing but the
    drive: not on the others, their number or order, the thread or the machine. Releases the GIL.
    The memory does not depend on the number and the length of the drives: at most 63 MB.

    Raises `ConfigError` if a road's table is not usable.
    """
    if not drives:
        return
    for drive in drives:
        _require_usable(drive)
    routes, roads = _routes(drives)
    cars = np.array([(*constants(d.vehicle, d.adhesion), *handling(d.vehicle)) for d in drives])
    waiting = np.argsort(routes["samples"], kind="stable").tolist()
    ended = np.full((len(drives), 2), NOBODY)
    memory, book = lane_memory.empty_lanes()
    truth = np.empty(BLOCK_SHAPE)
    while True:
        for lane in np.flatnonzero(book[DRIVE] == NOBODY)[: len(waiting)]:
            drive = waiting.pop()
            speed_mps = roads[routes["first"][drive], kernel.SPEED]
            lane_memory.begin(memory, book, lane, drive, cars[drive], speed_mps)
        if (book[DRIVE] == NOBODY).all():
            return
        kernel.simulate(
            routes, cars, roads, steps_per_sample, memory, book, truth.reshape(-1), ended
        )
        for lane, (drive, tick, _, first) in enumerate(book.T.tolist()):
            last = drive != NOBODY and ended[drive, kernel.SAMPLES] != NOBODY
            if last or tick - first == BLOCK:
                lost = int(ended[drive, kernel.LOST])
                channels = dict(zip(CHANNELS, truth[lane, :, : tick - first], strict=True))
                yield TruthBlock(drive, channels, last, None if lost == NOBODY else lost)
                book[FIRST, lane] = tick
            if last:
                lane_memory.clear(memory, book, lane)


def simulate_drives(
    drives: Sequence[LaneDrive], steps_per_sample: int = STEPS_PER_SAMPLE
) -> list[Truth]:
    """Return what happens in each drive as a whole; see `simulate_blocks`.

    Takes 120 bytes a sample.
    """
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


def planned_time_s(road: Road, distance_m: float) -> float:
    """Return the time to drive a distance at the road's target speed."""
    speed = np.append(road.speed_mps, road.speed_mps[0]) if road.closed else road.speed_mps
    lap_s = float(np.sum(2 * road.spacing_m / (speed[:-1] + speed[1:])))
    return lap_s * distance_m / road.length_m


def target_acceleration(road: Road) -> FloatArray:
    """Return the acceleration d(v²/2)/ds of the target speed at the road's entries, in m/s².

    Central differences; interpolated linearly it is continuous, so that a drive does not hinge on
    which side of an entry a sample falls.
    """
    energy = road.speed_mps**2 / 2
    if road.closed:
        return (np.roll(energy, -1) - np.roll(energy, 1)) / (2 * road.spacing_m)
    return np.gradient(energy, road.spacing_m)


def _table(road: Road) -> FloatArray:
    """Return what the kernel looks up of a road: curvature, target speed and acceleration.

    The table of a closed road goes on beyond its length by what a driver sees ahead.
    """
    columns = np.stack([road.curvature_1pm, road.speed_mps, target_acceleration(road)], axis=1)
    further = math.ceil(FARTHEST_VIEW_M / road.spacing_m) + 1 if road.closed else 0
    return np.take(columns, range(len(columns) + further), axis=0, mode="wrap")


def _routes(drives: Sequence[LaneDrive]) -> tuple[NDArray[np.void], FloatArray]:
    """Return what the kernel knows of the drives, `kernel.ROUTE`, and the table of all roads."""
    roads = {id(drive.road): drive.road for drive in drives}
    tables = [_table(road) for road in roads.values()]
    ends = np.cumsum([len(table) for table in tables])
    spans = dict(zip(roads, zip([0, *ends[:-1]], ends - 1, strict=True), strict=True))
    routes = np.array(
        [_route(drive, *spans[id(drive.road)]) for drive in drives], dtype=kernel.ROUTE
    )
    return routes, np.concatenate(tables)


def _route(
    drive: LaneDrive, first: int, last: int
) -> tuple[int, int, float, float, bool, float, int]:
    """Return a drive's row of `kernel.ROUTE`."""
    road = drive.road
    distance_m = (drive.laps if road.closed else min(drive.laps, 1.0)) * road.length_m
    samples = math.ceil((PATIENCE * planned_time_s(road, distance_m) + GRACE_S) / SAMPLE_S)
    return first, last, 1 / road.spacing_m, road.length_m, road.closed, distance_m, samples


def _require_usable(drive: LaneDrive) -> None:
    road = drive.road
    entries = len(road.curvature_1pm)
    if len(road.speed_mps) != entries or entries < 2:
        raise ConfigError(
            f"a road needs two or more entries of curvature and as many of speed, not {entries}"
            f" and {len(road.speed_mps)}."
        )
    intervals = entries if road.closed else entries - 1
    if abs(intervals * road.spacing_m - road.length_m) > 1e-6 * road.length_m:
        raise ConfigError(
            f"a road of {intervals} intervals of {road.spacing_m} m is not {road.length_m} m long."
        )
    if not (np.isfinite(road.curvature_1pm).all() and (road.speed_mps > LOST_SPEED_MPS).all()):
        raise ConfigError(
            f"a road needs finite curvature and target speeds above {LOST_SPEED_MPS} m/s."
        )
    if not 0 < drive.adhesion < math.inf or not 0 < drive.laps < math.inf:
        raise ConfigError(
            f"adhesion {drive.adhesion} and laps {drive.laps}: give positive numbers."
        )
