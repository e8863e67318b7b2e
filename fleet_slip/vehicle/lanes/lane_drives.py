"""Drives many cars at once: each drive is a lane of a loop that the compiler vectorises."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import ConfigError
from fleet_slip.vehicle.car_imperfections import PERFECT, CarImperfections, traits
from fleet_slip.vehicle.driver import SAMPLE_S, handling
from fleet_slip.vehicle.integration import STEP_S
from fleet_slip.vehicle.lanes import lane_kernel, lane_memory
from fleet_slip.vehicle.lanes.lane_memory import (
    BLOCK,
    CHANNELS,
    DRIVE,
    FIRST,
    IMPERFECT_CHANNELS,
    NOBODY,
    ROUTE,
    empty_blocks,
)
from fleet_slip.vehicle.lanes.road import (
    Road,
    Surface,
    planned_time_s,
    require_usable,
    road_table,
    surface_table,
)
from fleet_slip.vehicle.parameters import VehicleParameters, constants

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
    felt: bool = False
    """Whether to record `IMPERFECT_CHANNELS` for its sensors, even of a perfect car and road."""

    @property
    def imperfect(self) -> bool:
        """Whether the car, the road or the sensors are not those of the textbook."""
        return self.felt or self.flaws != PERFECT or self.road.surface is not None


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
    machine. Releases the GIL; takes at most 63 MB. Cars and roads with imperfections have a kernel
    of their own, and `IMPERFECT_CHANNELS` too. Raises `ConfigError` for an unusable road's table.
    """
    for drive in drives:
        require_usable(drive.road)
        if not 0 < drive.adhesion < math.inf or not 0 < drive.laps < math.inf:
            raise ConfigError(
                f"adhesion {drive.adhesion} and laps {drive.laps}: give positive numbers."
            )
    for imperfect in (False, True):
        numbers = [i for i, drive in enumerate(drives) if drive.imperfect == imperfect]
        alike = [drives[number] for number in numbers]
        for block in _simulate_alike(alike, imperfect, steps_per_sample):
            yield replace(block, drive=numbers[block.drive])


def _simulate_alike(
    drives: Sequence[LaneDrive], imperfect: bool, steps_per_sample: int
) -> Iterator[TruthBlock]:
    """Yield the blocks of drives that are all with imperfections, or all without."""
    if not drives:
        return
    simulate = lane_kernel.simulate_imperfect if imperfect else lane_kernel.simulate
    routes, roads = _routes(drives)
    surfaces = np.zeros((0, len(Surface._fields)))
    if imperfect:  # in the order of the table of all roads
        distinct = {id(drive.road): drive.road for drive in drives}
        surfaces = np.concatenate([surface_table(road) for road in distinct.values()])
    cars = np.array([_car(drive) for drive in drives])
    waiting = np.argsort(routes["samples"], kind="stable").tolist()
    ended = np.full((len(drives), 2), NOBODY)
    memory, book = lane_memory.empty_lanes()
    truth, usual, further = empty_blocks(imperfect)
    while True:
        for lane in np.flatnonzero(book[DRIVE] == NOBODY)[: len(waiting)]:
            drive = waiting.pop()
            speed_mps = roads[routes["first"][drive], lane_kernel.SPEED]
            lane_memory.begin(memory, book, lane, drive, cars[drive], speed_mps)
        if (book[DRIVE] == NOBODY).all():
            return
        simulate(routes, cars, roads, surfaces, steps_per_sample, memory, book, truth, ended)
        for lane, (drive, tick, _, first) in enumerate(book.T.tolist()):
            last = drive != NOBODY and ended[drive, lane_kernel.SAMPLES] != NOBODY
            if last or tick - first == BLOCK:
                lost = int(ended[drive, lane_kernel.LOST])
                channels = dict(zip(CHANNELS, usual[lane, :, : tick - first], strict=True))
                if imperfect:
                    more = further[lane, :, : tick - first]
                    channels |= dict(zip(IMPERFECT_CHANNELS, more, strict=True))
                yield TruthBlock(drive, channels, last, None if lost == NOBODY else lost)
                book[FIRST, lane] = tick
            if last:
                lane_memory.clear(memory, book, lane)


def _car(drive: LaneDrive) -> tuple[float, ...]:
    return (
        *constants(drive.vehicle, drive.adhesion),
        *handling(drive.vehicle, math.radians(drive.flaws.steering_compliance_deg_per_kn) / 1000),
        *traits(drive.vehicle, drive.flaws, SAMPLE_S),
    )


def _routes(drives: Sequence[LaneDrive]) -> tuple[NDArray[np.void], FloatArray]:
    roads = {id(drive.road): drive.road for drive in drives}
    tables = [road_table(road) for road in roads.values()]
    ends = np.cumsum([len(table) for table in tables])
    spans = dict(zip(roads, zip([0, *ends[:-1]], ends - 1, strict=True), strict=True))
    routes = np.array([_route(drive, *spans[id(drive.road)]) for drive in drives], dtype=ROUTE)
    return routes, np.concatenate(tables)


def _route(
    drive: LaneDrive, first: int, last: int
) -> tuple[int, int, float, float, bool, float, int]:
    road = drive.road
    distance_m = (drive.laps if road.closed else min(drive.laps, 1.0)) * road.length_m
    samples = math.ceil((PATIENCE * planned_time_s(road, distance_m) + GRACE_S) / SAMPLE_S)
    return first, last, 1 / road.spacing_m, road.length_m, road.closed, distance_m, samples
