"""Delay of the satellite receiver of each car: its speed against the acceleration, from Gram rows.

A receiver's speed is as late as its course. The change of speed over 0.4 s is the integral of the
longitudinal acceleration; changes of both over 0.4 s more are free of its offset. The lag of the
integral with the smallest sum of squares, by a parabola, is the delay. The integral k ticks late is
that of 40 + k ticks less that of k, which Gram rows have. Its uncertainty is a jackknife over
drives, and what all have in common. Cars with one type of receiver are drawn towards its delay, the
more so the fewer drives they have (`regression/inference.py`).
"""

import math
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record
from fleet_slip.catalog.course import LATE_PARTS, MAX_COURSE_DELAY, MIN_COURSE_DELAY
from fleet_slip.catalog.definitions import DELAY
from fleet_slip.catalog.signals import RECEIVER, SAMPLE_TIME_S
from fleet_slip.regression.gram import GramTable
from fleet_slip.regression.inference import Pooled, pool
from fleet_slip.storage.table import Snapshot
from fleet_slip.warehouse.erasure_log import find_erased
from fleet_slip.warehouse.gram_reader import by_signals, gram_table, is_onboard, rows_of_set
from fleet_slip.warehouse.warehouse import Warehouse

SPAN, STEP, STEPS = 40, 5, 12
"""Ticks of the integral, between two lags, and how many lags there are beside the first. Receivers
of 5 Hz have fixes that are so far apart."""
EARLY = 20
"""Ticks by which a receiver may be earlier than the accelerometer."""
SPEEDS = (f"satellite_speed_late_{EARLY}", f"satellite_speed_late_{EARLY + SPAN}")
SYSTEMATIC_STD_S = 0.003
"""Standard error that drives do not average out: tilt and low-pass of the accelerometer."""
TINY = 1e-9
"""Minimum curvature of the sum of squares of a drive, relative to the sum."""
MIN_DRIVES = 3
"""With fewer drives the uncertainty is that of the drives of other cars."""
OUTLIER_RATIO = 100.0
"""Scatter of the drives of a car over that of the median car, beyond which it is an outlier."""


@dataclass(frozen=True)
class ReceiverDelay(Record):
    """The delay of a car's receiver behind its accelerometer, s; few drives tell no error.

    `information` is how much a wrong lag adds to the sum of squares, per s^2; `differing` the sum
    over drives of their own pulls by it: on average the noise times one less than the drives.
    `receiver` is its type; None if no drive says it, or drives say several.
    """

    DOCUMENT = "receiver delay_s=value uncertainty_s=uncertainty drives rows"

    value: float
    uncertainty: float | None
    drives: int
    rows: int
    information: float
    differing: float
    receiver: str | None = None

    def __str__(self) -> str:
        if self.uncertainty is None:
            return f"{1000 * self.value:.0f} ms, from too few drives"
        return f"{1000 * self.value:.0f} +- {1000 * self.uncertainty:.0f} ms"


@dataclass(frozen=True)
class ReceiverDelays:
    """The delay of each car's receiver, and of the types of which there are enough, by name."""

    cars: dict[str, ReceiverDelay]
    types: dict[str, Pooled]


NO_RECEIVERS = ReceiverDelays({}, {})


def delay_columns() -> tuple[str, ...]:
    """Return the columns that determine a delay: speeds, then sums of acceleration."""
    lags = range(0, STEP * STEPS + 1, STEP)
    ticks = sorted({*lags[1:], *(SPAN + lag for lag in lags)})
    return (*SPEEDS, *(f"ax_sum_{n}" for n in ticks))


def _weights() -> FloatArray:
    """Return the weights of the columns in the change of speed and in its delayed integrals."""
    columns = delay_columns()
    weights = np.zeros((2 + STEPS, len(columns)))
    weights[0, :2] = 1, -1
    for late in range(STEPS + 1):
        weights[1 + late, columns.index(f"ax_sum_{SPAN + STEP * late}")] = 1
        if late:
            weights[1 + late, columns.index(f"ax_sum_{STEP * late}")] = -1
    return weights


def receiver_delays(rows_of_delay: Iterable[pa.RecordBatch]) -> ReceiverDelays:
    """Estimate the delays of cars and of receiver types from Gram rows of the set `delay`."""
    columns = delay_columns()
    products: dict[str, dict[tuple[str, str], FloatArray]] = defaultdict(dict)
    receivers = defaultdict[str, set[str]](set)
    counts = Counter[str]()
    for batch in rows_of_delay:
        for names, rows, _ in by_signals(batch.filter(batch["vehicle_id"].is_valid())):
            if not set(columns) <= set(names.split(",")):
                continue
            table = gram_table(names, rows).restrict(columns)
            key_columns = ("vehicle_id", "day", "drive_id", RECEIVER)
            keys = (rows[name].to_pylist() for name in key_columns)
            for (car, day, drive, receiver), about, n in zip(
                zip(*keys, strict=True), _about_means(table), table.n.tolist(), strict=True
            ):
                drives = products[car]
                drives[str(day), drive] = drives.get((str(day), drive), 0.0) + about
                receivers[car] |= {receiver} - {None}
                counts[car] += n
    delays = {}
    for car, drives in sorted(products.items()):
        delay = _delay(np.array([drives[drive] for drive in sorted(drives)]), counts[car])
        if delay is not None:
            receiver = receivers[car].pop() if len(receivers[car]) == 1 else None
            delays[car] = replace(delay, receiver=receiver)
    return with_types(with_pooled(delays))


def _about_means(table: GramTable) -> FloatArray:
    """Return products about the means of drives, (drives, 2 + STEPS, 2 + STEPS)."""
    weights, moments = _weights(), table.moments()
    sums = moments[:, 0, 1:] @ weights.T
    squares = sums[:, :, None] * sums[:, None, :] / table.n[:, None, None]
    return np.asarray(weights @ moments[:, 1:, 1:] @ weights.T - squares)


def with_pooled(delays: dict[str, ReceiverDelay]) -> dict[str, ReceiverDelay]:
    """Complete the uncertainty of cars with few drives from other cars; None if all have few."""
    noise, completed = _noise(delays.values()), dict(delays)
    for car, delay in delays.items():
        if delay.drives < MIN_DRIVES or delay.uncertainty is None:
            usual = noise and math.sqrt(noise / delay.information + SYSTEMATIC_STD_S**2)
            completed[car] = replace(delay, uncertainty=usual)
    return completed


def with_types(delays: dict[str, ReceiverDelay]) -> ReceiverDelays:
    """Return the delays with those of cars of one type of receiver drawn towards the type's.

    Their variances follow from how much drives of the type differ. What is the same in all drives
    of a car is no part of what drawing makes smaller.
    """
    cars, types = dict(delays), {}
    for name in sorted({d.receiver for d in delays.values() if d.receiver is not None}):
        of_type = {car: delay for car, delay in delays.items() if delay.receiver == name}
        noise = _noise(of_type.values())
        figures = np.array([(delay.value, delay.information) for delay in of_type.values()])
        pooled = pool(figures[:, 0], noise / figures[:, 1]) if noise else None
        if pooled is not None:
            types[name] = pooled
            for (car, delay), value, error in zip(
                of_type.items(), pooled.values.tolist(), pooled.errors.tolist(), strict=True
            ):
                cars[car] = replace(
                    delay, value=value, uncertainty=math.hypot(error, SYSTEMATIC_STD_S)
                )
    return ReceiverDelays(cars, types)


def _noise(delays: Iterable[ReceiverDelay]) -> float | None:
    """Return the variance of a delay times information, as drives of cars differ, or None.

    Without cars whose drives differ wildly more than those of half of the cars: their receivers or
    logs are faulty, and one of them would make the delays of all others uncertain.
    """
    several = [delay for delay in delays if delay.drives > 1]
    usual = statistics.median([d.differing / (d.drives - 1) for d in several] or [0.0])
    usable = [d for d in several if d.differing <= OUTLIER_RATIO * usual * (d.drives - 1)]
    degrees = sum(d.drives - 1 for d in usable)
    if degrees < MIN_DRIVES - 1:
        return None
    return math.fsum(d.differing for d in usable) / degrees


def _delay(products: FloatArray, rows: int) -> ReceiverDelay | None:
    drives, total = len(products), products.sum(axis=0)
    best = _best_lag(total)
    if best is None:
        return None
    slope, bend = _parabolas(products)
    without = [lag for drive in products if (lag := _best_lag(total - drive)) is not None]
    uncertainty = None
    if len(without) == drives > 1:
        mean = math.fsum(without) / drives
        square = math.fsum((lag - mean) ** 2 for lag in without)
        scatter = math.sqrt(square * (drives - 1) / drives) * float(SAMPLE_TIME_S)
        uncertainty = math.hypot(scatter, SYSTEMATIC_STD_S)
    return ReceiverDelay(
        value=best * float(SAMPLE_TIME_S),
        uncertainty=uncertainty,
        drives=drives,
        rows=rows,
        information=float(bend.sum()),
        differing=float(((slope - bend * slope.sum() / bend.sum()) ** 2 / bend).sum()),
    )


def _parabolas(products: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the slope and bend of each drive's sum of squares by the delay of all, in s."""
    total = products.sum(axis=0)
    middle = _middle(total)
    at = np.arange(middle, middle + 3)  # the first is of the speed
    ratio = total[0, middle + 1] / total[middle + 1, middle + 1]
    squares = ratio**2 * products[:, at, at] - 2 * ratio * products[:, 0, at]
    before, center, after = squares.T
    step = STEP * float(SAMPLE_TIME_S)
    bend = np.maximum(after - 2 * center + before, TINY * abs(total[0, 0]))
    return (after - before) / (2 * step), bend / step**2


def _middle(products: FloatArray) -> int:
    """Return the lag that explains most of the speed's changes, and has one on either side."""
    explained = products[0, 1:] ** 2 / np.diag(products)[1:]
    return min(max(int(np.argmax(explained)), 1), STEPS - 1)


def _best_lag(products: FloatArray) -> float | None:
    """Return the lag in ticks that explains most of the speed's changes; None without any."""
    sizes = np.diag(products)[1:]
    if not (sizes > 0).all():
        return None
    explained = products[0, 1:] ** 2 / sizes
    middle = _middle(products)
    before, center, after = explained[middle - 1 : middle + 2]
    bend = 2 * center - before - after
    if bend <= 0:
        return None
    # A sum of ticks is the integral up to half a tick after the last one.
    return STEP * (middle + 0.5 * float(after - before) / float(bend)) - 0.5 - EARLY


# How late the course of each car is, and which Gram rows were computed with another delay.
#
# The delay is a whole number of parts of a tick, a pure function of the Gram rows of the set
# `delay`: the same drives in any order give the same rows, and forgotten ones leave nothing.

GRAIN_S = float(SAMPLE_TIME_S) / LATE_PARTS
"""Unit of integer delays, s."""


def course_delays(warehouse: Warehouse, grams: Snapshot, active: frozenset[str]) -> dict[str, int]:
    """Return each car's course delay in parts of a tick, of Gram rows of the `active` log files.

    Rows of erased cars and drives, which an old backup brought back, do not count.
    """
    erased = find_erased(warehouse.root, grams.table, [grams])
    counted = pa.array(sorted(active), pa.string())
    columns = ("file", "day", "vehicle_id", "drive_id", RECEIVER)

    def batches() -> Iterator[pa.RecordBatch]:
        identity = warehouse.catalog.identity(DELAY)
        for rows in rows_of_set(grams, identity, *columns, "signals", "n", "sums", "products"):
            counts = pc.or_(pc.is_in(rows["file"].cast(pa.string()), counted), is_onboard(rows))
            for column, names in erased.by_column.items():
                returned = pc.is_in(rows[column].cast(pa.string()), pa.array(names, pa.string()))
                counts = pc.and_(counts, pc.invert(returned))
            yield from rows.filter(counts).to_batches()

    earliest, latest = LATE_PARTS * MIN_COURSE_DELAY, LATE_PARTS * MAX_COURSE_DELAY
    return {
        car: min(max(round(delay.value / GRAIN_S), earliest), latest)
        for car, delay in receiver_delays(batches()).cars.items()
    }
