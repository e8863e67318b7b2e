"""Drives many cars at once: each drive is a lane of a loop that the compiler vectorises."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import ConfigError
from fleet_slip.vehicle import batch_kernel
from fleet_slip.vehicle.batch_kernel import (
    BLOCK,
    CHANNELS,
    DRIVE,
    FIRST,
    LOST_SPEED_MPS,
    NOBODY,
    ROUTE,
)
from fleet_slip.vehicle.driver import SAMPLE_S, handling
from fleet_slip.vehicle.integration import STEP_S
from fleet_slip.vehicle.parameters import (
    PERFECT,
    CarImperfections,
    Controls,
    State,
    VehicleParameters,
    constants,
    traits,
)

# The road that a lane's driver follows, as the kernel looks it up.

FARTHEST_VIEW_M = 20.0
"""How far beyond a lap's end a driver may look."""


class Surface(NamedTuple):
    """What is not flat, even and calm about a road, at its entries: arrays of shape (m,)."""

    gravity_x_mps2: FloatArray
    """Weight per mass along the road; negative uphill."""
    gravity_y_mps2: FloatArray
    """Weight per mass across the road, positive where it pulls to the left."""
    grip_left: FloatArray
    """Adhesion under the left wheels over that of the drive."""
    grip_right: FloatArray
    cross_wind_mps: FloatArray
    """Speed of the air across the road, positive to the left."""


class Road(NamedTuple):
    """The line to follow and the speed to hold, at equal steps of the station from 0.

    A closed road is a whole number of spacings long, and the entry after the last is the first.
    """

    spacing_m: float
    curvature_1pm: FloatArray
    """Curvature of the line, (m,), positive to the left."""
    speed_mps: FloatArray
    """Target speed, (m,), already times the speed factor."""
    length_m: float
    closed: bool
    surface: Surface | None = None
    """None: flat, even and calm."""


def planned_time_s(road: Road, distance_m: float) -> float:
    """Return the time to drive a distance at the road's target speed."""
    speed = np.append(road.speed_mps, road.speed_mps[0]) if road.closed else road.speed_mps
    lap_s = float(np.sum(2 * road.spacing_m / (speed[:-1] + speed[1:])))
    return lap_s * distance_m / road.length_m


def target_acceleration(road: Road) -> FloatArray:
    """Return d(v²/2)/ds of the target speed at the entries, m/s², by central differences."""
    energy = road.speed_mps**2 / 2
    if road.closed:
        return (np.roll(energy, -1) - np.roll(energy, 1)) / (2 * road.spacing_m)
    return np.gradient(energy, road.spacing_m)


def surface_table(road: Road) -> FloatArray:
    """Return what the kernel looks up of a road's surface."""
    zero, one = np.zeros(len(road.curvature_1pm)), np.ones(len(road.curvature_1pm))
    flat_even_and_calm = Surface(zero, zero, one, one, zero)
    return _continued(road, *(road.surface or flat_even_and_calm))


def _continued(road: Road, *columns_of_road: FloatArray) -> FloatArray:
    """Return a road's table; that of a closed one goes on by what a driver sees ahead."""
    columns = np.stack(columns_of_road, axis=1)
    further = math.ceil(FARTHEST_VIEW_M / road.spacing_m) + 1 if road.closed else 0
    return np.take(columns, range(len(columns) + further), axis=0, mode="wrap")


def require_usable(road: Road) -> None:
    """Raise `ConfigError` if a road's tables are not usable."""
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
    if road.surface and any(len(c) != entries or not np.isfinite(c).all() for c in road.surface):
        raise ConfigError(f"a surface needs {entries} finite entries, as many as its road.")


STEPS_PER_SAMPLE = round(SAMPLE_S / STEP_S)

PATIENCE = 1.25
"""A drive that takes so many times its planned time ends."""

GRACE_S = 5.0
"""Time that every drive may take beyond that."""


@dataclass(frozen=True)
class LaneDrive:
    """One drive to simulate. It starts at station 0, on the line, at the road's target speed."""

    vehicle: VehicleParameters
    road: Road
    adhesion: float
    """Adhesion coefficient μ of the road, 1 on dry asphalt."""
    laps: float
    """Length of the drive in lengths of the road."""
    flaws: CarImperfections = PERFECT


@dataclass(frozen=True)
class TruthBlock:
    """What happened in a part of a drive: at most `BLOCK` samples, without a gap."""

    drive: int
    channels: dict[str, FloatArray]
    """The arrays of `CHANNELS`. Their memory is used again for the next block."""
    last: bool
    lost_control_tick: int | None
    """First tick of the drive at which the driver had lost the car; None in a block before."""


def simulate_blocks(
    drives: Sequence[LaneDrive], steps_per_sample: int = STEPS_PER_SAMPLE
) -> Iterator[TruthBlock]:
    """Yield what happens in each drive, sampled at 100 Hz from its start, block by block.

    The blocks of a drive come in order, those of different drives in any. A drive ends after its
    laps, at the end of an open road, `AFTER_LOSS` samples after the car was lost, or after
    `PATIENCE` times the planned time. Its bits depend on the drive alone, not on others, threads or
    machine. Releases the GIL; takes at most 76 MB. Raises `ConfigError` for an unusable road's
    table.
    """
    for drive in drives:
        require_usable(drive.road)
        if not 0 < drive.adhesion < math.inf or not 0 < drive.laps < math.inf:
            raise ConfigError(
                f"adhesion {drive.adhesion} and laps {drive.laps}: give positive numbers."
            )
    if not drives:
        return
    routes, roads, surfaces = _routes(drives)
    waiting = np.argsort(routes["samples"], kind="stable").tolist()
    ended = np.full((len(drives), 2), NOBODY)
    memory, book = batch_kernel.empty_lanes()
    truth, blocks = batch_kernel.empty_blocks()
    while True:
        for lane in np.flatnonzero(book[DRIVE] == NOBODY)[: len(waiting)]:
            number = waiting.pop()
            speed_mps = roads[routes["first"][number], batch_kernel.SPEED]
            batch_kernel.begin(memory, book, lane, number, _car(drives[number]), speed_mps)
        if (book[DRIVE] == NOBODY).all():
            return
        batch_kernel.simulate(routes, roads, surfaces, steps_per_sample, memory, book, truth, ended)
        for lane, (number, tick, _, first) in enumerate(book.T.tolist()):
            last = number != NOBODY and ended[number, batch_kernel.SAMPLES] != NOBODY
            if last or tick - first == BLOCK:
                lost = int(ended[number, batch_kernel.LOST])
                channels = dict(zip(CHANNELS, blocks[lane, :, : tick - first], strict=True))
                yield TruthBlock(number, channels, last, None if lost == NOBODY else lost)
                book[FIRST, lane] = tick
            if last:
                batch_kernel.clear(memory, book, lane)


def simulate_samples(drive: LaneDrive, samples: int) -> Iterator[tuple[Controls, State]]:
    """Yield, sample by sample, what the kernel's driver demands and where that takes the car."""
    routes, roads, surfaces = _routes([drive])
    memory, book = batch_kernel.empty_lanes()
    truth, _ = batch_kernel.empty_blocks()
    batch_kernel.begin(memory, book, 0, 0, _car(drive), roads[0, batch_kernel.SPEED])
    column = memory.reshape(batch_kernel.ROWS, batch_kernel.LANES)[:, 0]
    for sample in range(samples):
        routes["samples"], ended = sample + 1, np.full((1, 2), NOBODY)
        book[FIRST, 0] = sample
        batch_kernel.simulate(routes, roads, surfaces, STEPS_PER_SAMPLE, memory, book, truth, ended)
        demanded = column[batch_kernel.CONTROLS :][: len(Controls._fields)].tolist()
        moved = column[batch_kernel.STATE :][: len(State._fields)].tolist()
        yield Controls(*demanded), State(*moved)


def _car(drive: LaneDrive) -> FloatArray:
    """Return `Constants`, `Handling` and `Traits` as the kernel has them."""
    compliance_rad_per_n = math.radians(drive.flaws.steering_compliance_deg_per_kn) / 1000
    return np.array(
        [
            *constants(drive.vehicle, drive.adhesion),
            *handling(drive.vehicle, compliance_rad_per_n),
            *traits(drive.vehicle, drive.flaws, SAMPLE_S),
        ]
    )


def _routes(drives: Sequence[LaneDrive]) -> tuple[NDArray[np.void], FloatArray, FloatArray]:
    """Return the way of each drive, and the tables of all roads and surfaces that it points to."""
    roads = {id(drive.road): drive.road for drive in drives}
    tables = [
        _continued(road, road.curvature_1pm, road.speed_mps, target_acceleration(road))
        for road in roads.values()
    ]
    ends = np.cumsum([len(table) for table in tables])
    spans = dict(zip(roads, zip([0, *ends[:-1]], ends - 1, strict=True), strict=True))
    routes = np.array([_route(drive, *spans[id(drive.road)]) for drive in drives], dtype=ROUTE)
    surfaces = [surface_table(road) for road in roads.values()]
    return routes, np.concatenate(tables), np.concatenate(surfaces)


def _route(
    drive: LaneDrive, first: int, last: int
) -> tuple[int, int, float, float, bool, float, int]:
    road = drive.road
    distance_m = (drive.laps if road.closed else min(drive.laps, 1.0)) * road.length_m
    samples = math.ceil((PATIENCE * planned_time_s(road, distance_m) + GRACE_S) / SAMPLE_S)
    return first, last, 1 / road.spacing_m, road.length_m, road.closed, distance_m, samples
