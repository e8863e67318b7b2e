"""Simulates many drives at once: each is a lane of a loop that the compiler vectorises."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import ConfigError
from fleet_slip.vehicle import batch_kernel
from fleet_slip.vehicle.batch_kernel import (
    ABSENT,
    BLOCK,
    CHANNELS,
    DRIVE,
    FIRST,
    LOST_SPEED_MPS,
    ROUTE,
)
from fleet_slip.vehicle.driver import SAMPLE_S, handling
from fleet_slip.vehicle.integration import STEP_S
from fleet_slip.vehicle.parameters import (
    PERFECT,
    CarImperfections,
    VehicleParameters,
    constants,
    imperfection_constants,
)

MAX_PREVIEW_M = 20.0
"""Length of the table of a closed road beyond a lap's end, in m: the driver's preview."""


class Surface(NamedTuple):
    """Slopes, adhesion and wind at the entries of a road, arrays of shape (m,)."""

    gravity_x_mps2: FloatArray
    """Component of gravity along the road; negative uphill."""
    gravity_y_mps2: FloatArray
    """Component of gravity across the road, positive to the left."""
    grip_left: FloatArray
    """Adhesion under the left wheels over the adhesion of the drive."""
    grip_right: FloatArray
    """Adhesion under the right wheels over the adhesion of the drive."""
    cross_wind_mps: FloatArray
    """Speed of the air across the road, positive to the left."""


class Road(NamedTuple):
    """A line to follow and the speed to hold, at equal steps of the station from 0.

    The length of a closed road is a whole number of spacings. Its last entry is followed by the
    first.
    """

    spacing_m: float
    curvature_1pm: FloatArray
    """Curvature of the line, (m,), positive to the left."""
    speed_mps: FloatArray
    """Target speed, (m,), including the speed factor of the drive."""
    length_m: float
    closed: bool
    surface: Surface | None = None
    """None: flat, even and calm."""


def planned_time_s(road: Road, distance_m: float) -> float:
    """Return the time that a distance takes at the road's target speed."""
    speed = np.append(road.speed_mps, road.speed_mps[0]) if road.closed else road.speed_mps
    lap_s = float(np.sum(2 * road.spacing_m / (speed[:-1] + speed[1:])))
    return lap_s * distance_m / road.length_m


def target_acceleration(road: Road) -> FloatArray:
    """Return d(v²/2)/ds of the target speed at the entries in m/s², by central differences."""
    energy = road.speed_mps**2 / 2
    if road.closed:
        return (np.roll(energy, -1) - np.roll(energy, 1)) / (2 * road.spacing_m)
    return np.gradient(energy, road.spacing_m)


def _table(road: Road, *columns: FloatArray) -> FloatArray:
    """Stack columns of a road; those of a closed road continue beyond the lap's end."""
    extra = math.ceil(MAX_PREVIEW_M / road.spacing_m) + 1 if road.closed else 0
    return np.take(np.stack(columns, axis=1), range(len(columns[0]) + extra), axis=0, mode="wrap")


def _surface_table(road: Road) -> FloatArray:
    zeros, ones = np.zeros(len(road.curvature_1pm)), np.ones(len(road.curvature_1pm))
    return _table(road, *(road.surface or Surface(zeros, zeros, ones, ones, zeros)))


def require_valid_road(road: Road) -> None:
    """Raise `ConfigError` if the tables of a road are not valid."""
    entries = len(road.curvature_1pm)
    intervals = entries if road.closed else entries - 1
    columns = (road.curvature_1pm, road.speed_mps, *(road.surface or ()))
    if entries < 2 or any(len(c) != entries or not np.isfinite(c).all() for c in columns):
        raise ConfigError(
            "the road has missing or infinite entries of curvature, speed or surface. Give as many "
            "finite ones of each, at least two."
        )
    if abs(intervals * road.spacing_m - road.length_m) > 1e-6 * road.length_m:
        raise ConfigError(
            f"the road has {intervals} intervals of {road.spacing_m} m, but a length of "
            f"{road.length_m} m. Give a length that agrees."
        )
    if not (road.speed_mps > LOST_SPEED_MPS).all():
        raise ConfigError(
            f"the road has a target speed that is too low. Give speeds above {LOST_SPEED_MPS} m/s."
        )


STEPS_PER_SAMPLE = round(SAMPLE_S / STEP_S)

MAX_TIME_FACTOR = 1.25
"""A drive ends after this multiple of its planned time, plus `EXTRA_TIME_S`."""

EXTRA_TIME_S = 5.0
"""Time in s that every drive may take beyond `MAX_TIME_FACTOR`: short drives start slowly."""


@dataclass(frozen=True)
class LaneDrive:
    """A drive to simulate. It starts at station 0, on the line, at the road's target speed."""

    vehicle: VehicleParameters
    road: Road
    adhesion: float
    """Adhesion coefficient μ of the road, 1 on dry asphalt."""
    laps: float
    """Length of the drive in lengths of the road."""
    flaws: CarImperfections = PERFECT


@dataclass(frozen=True)
class TruthBlock:
    """The true motion of a car in at most `BLOCK` consecutive samples of a drive."""

    drive: int
    channels: dict[str, FloatArray]
    """The arrays of `CHANNELS`. The next block reuses their memory."""
    last: bool
    lost_control_tick: int | None
    """Tick of the drive at which the driver lost the car; None in earlier blocks."""


def simulate_blocks(
    drives: Sequence[LaneDrive],
    steps_per_sample: int = STEPS_PER_SAMPLE,
    simulate_lanes: Callable[..., None] = batch_kernel.simulate_lanes,
) -> Iterator[TruthBlock]:
    """Simulate drives, sampled at 100 Hz from their start.

    A drive ends after its laps, at the end of an open road, `SAMPLES_AFTER_LOSS` samples after a
    loss of control, or after `MAX_TIME_FACTOR` times the planned time. Its bits depend on the drive
    alone, not on other drives, threads or the machine. The GIL is released.

    Parameters
    ----------
    drives
        The drives. The blocks of all lanes take at most 76 MB.
    steps_per_sample
        Integration steps of each sample of 10 ms.
    simulate_lanes
        The loop over time and lanes: the kernel, or `highway.HighwayLanes` of these drives.

    Yields
    ------
    TruthBlock
        Blocks of a drive in their order; blocks of different drives in any order.

    Raises
    ------
    ConfigError
        If a road, an adhesion or a number of laps is not valid.
    """
    for drive in drives:
        require_valid_road(drive.road)
        if not 0 < drive.adhesion < math.inf or not 0 < drive.laps < math.inf:
            raise ConfigError(
                f"adhesion {drive.adhesion} and laps {drive.laps}: give positive numbers."
            )
    if not drives:
        return
    routes, roads, surfaces = _routes(drives)
    waiting = np.argsort(routes["samples"], kind="stable").tolist()
    results = np.full((len(drives), 2), ABSENT)
    memory, lane_table = batch_kernel.empty_lanes()
    truth, blocks = batch_kernel.empty_blocks()
    while True:
        for lane in np.flatnonzero(lane_table[DRIVE] == ABSENT)[: len(waiting)]:
            index = waiting.pop()
            speed_mps = roads[routes["first"][index], batch_kernel.SPEED]
            car = _car(drives[index])
            batch_kernel.start_drive(memory, lane_table, lane, index, car, speed_mps)
        if (lane_table[DRIVE] == ABSENT).all():
            return
        simulate_lanes(
            routes, roads, surfaces, steps_per_sample, memory, lane_table, truth, results
        )
        for lane, (index, tick, _, first) in enumerate(lane_table.T.tolist()):
            last = index != ABSENT and results[index, batch_kernel.SAMPLES] != ABSENT
            if last or tick - first == BLOCK:
                lost = int(results[index, batch_kernel.LOST])
                channels = dict(zip(CHANNELS, blocks[lane, :, : tick - first], strict=True))
                yield TruthBlock(index, channels, last, None if lost == ABSENT else lost)
                lane_table[FIRST, lane] = tick
            if last:
                batch_kernel.vacate(memory, lane_table, lane)


def _car(drive: LaneDrive) -> FloatArray:
    """Return `Constants`, `Handling` and `ImperfectionConstants` in the kernel's order."""
    compliance_rad_per_n = math.radians(drive.flaws.steering_compliance_deg_per_kn) / 1000
    return np.array(
        [
            *constants(drive.vehicle, drive.adhesion),
            *handling(drive.vehicle, compliance_rad_per_n),
            *imperfection_constants(drive.vehicle, drive.flaws, SAMPLE_S),
        ]
    )


def _routes(drives: Sequence[LaneDrive]) -> tuple[NDArray[np.void], FloatArray, FloatArray]:
    """Return the route of each drive, and the tables of all roads and surfaces."""
    roads = {id(drive.road): drive.road for drive in drives}
    tables = [
        _table(road, road.curvature_1pm, road.speed_mps, target_acceleration(road))
        for road in roads.values()
    ]
    ends = np.cumsum([len(table) for table in tables])
    spans = dict(zip(roads, zip([0, *ends[:-1]], ends - 1, strict=True), strict=True))
    routes = np.array([_route(drive, *spans[id(drive.road)]) for drive in drives], dtype=ROUTE)
    surfaces = [_surface_table(road) for road in roads.values()]
    return routes, np.concatenate(tables), np.concatenate(surfaces)


def _route(
    drive: LaneDrive, first: int, last: int
) -> tuple[int, int, float, float, bool, float, int]:
    road = drive.road
    distance_m = (drive.laps if road.closed else min(drive.laps, 1.0)) * road.length_m
    limit_s = MAX_TIME_FACTOR * planned_time_s(road, distance_m) + EXTRA_TIME_S
    samples = math.ceil(limit_s / SAMPLE_S)
    return first, last, 1 / road.spacing_m, road.length_m, road.closed, distance_m, samples
