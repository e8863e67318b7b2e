"""Relations of vehicle dynamics that the rows of a drive contradict: signs, units, delays, swaps.

The values are all well formed. Axes and signs are ISO 8855.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from itertools import islice
from typing import Any

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.course import SATELLITE_SPEED
from fleet_slip.catalog.signals import MEASURED, SAMPLE_TIME_S, SignalCatalog
from fleet_slip.quality.checks import CHECKS, Fault
from fleet_slip.quality.course_relation import check_course
from fleet_slip.quality.drive_signals import (
    MIN_CORRELATION,
    MIN_TICKS,
    RADIUS_M,
    SIGNED,
    SPEEDS_OF_CAR,
    TICKS_PER_S,
    TRACK_M,
    WHEELS,
    MeanMoments,
    Signals,
    is_moving,
    slope_of,
    speed_mps,
    to_regular_grid,
    wheel_speed_mps,
)
from fleet_slip.quality.label_motion import check_label, is_yaw_rate_reversed
from fleet_slip.quality.turning import (
    MIN_MEAN_RATIO,
    WITNESSES,
    find_delays,
    find_reversed_or_swapped,
    find_swapped_axes,
)
from fleet_slip.warehouse.predicate import Predicate, guarded_query
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.warehouse import Warehouse


def check_plausibility(
    catalog: SignalCatalog, signals: Signals, *, from_velocities: bool = False
) -> list[Fault]:
    """Run the checks of a drive's rows; too few rows raise no fault.

    Each check passes over signals that an earlier one found faulty. The label of a drive may be
    computed from its velocities, where its remedies concern these.
    """
    faults = list(_without_change(catalog, signals))
    sound = _without(signals, faults)
    moving = is_moving(sound)
    one_sided = list(find_one_sided(sound, moving, catalog.label))
    faults += (fault for fault in one_sided if catalog.label not in fault.signals)
    faults += _turning(_without(sound, faults), moving, catalog.label)
    faults += find_delays(_without(sound, faults), moving)
    wrong_speeds = list(_speeds(sound, moving))
    faults += wrong_speeds
    speed = speed_mps(_without(sound, wrong_speeds))
    if speed is not None:
        faults += _sizes(_without(sound, faults), speed, moving)
        faults += _axles(_without(sound, faults), speed, moving)
    remaining = _without(sound, faults)
    label = check_label(catalog.label, remaining, speed, moving, from_velocities=from_velocities)
    if one_sided and catalog.label in one_sided[-1].signals:
        # A biased label is on one side, too.
        label = label if any(fault.kind == "biased" for fault in label) else one_sided[-1:]
    faults += label
    faults = _with_axes(faults, signals, catalog.label)
    return [*faults, *islice(check_course(_without(sound, faults)), 1)]


_STEERING = ("steering_wheel", "steer", "steer_fl", "steer_fr")
_WHEEL_PAIRS = ({"wheel_fl", "wheel_fr"}, {"wheel_rl", "wheel_rr"})


def _with_axes(faults: list[Fault], signals: Signals, label: str) -> list[Fault]:
    """Return one fault for axes that point down, in place of one for each signal.

    Then ay and yaw rate are reversed together. With the steering they outvote the wheels, whose
    columns seem to be swapped at both axles.
    """
    reversed_ = {f.signals[0] for f in faults if f.kind == "reversed" and len(f.signals) == 1}
    pairs = [f for f in faults if f.kind == "swapped" and set(f.signals) in _WHEEL_PAIRS]
    steering = {name for name in _STEERING if name in signals}
    if len(pairs) == len(_WHEEL_PAIRS) and not reversed_ & {"ay", "yaw_rate", *steering}:
        axes = {"ay", "yaw_rate", *steering, label, "vy"} & set(signals)
        names = axes - ({label, "vy"} if label in reversed_ else set())
        replaced = {name for pair in pairs for name in pair.signals} | {label}
        witnesses = "the wheels, unless left and right are swapped at both axles"
    elif {"ay", "yaw_rate"} <= reversed_:
        names = reversed_ & {"ay", "yaw_rate", *steering, label}
        replaced, witnesses = names, "the other signs of turning"
    else:
        return faults
    remaining = [fault for fault in faults if not set(fault.signals) <= replaced]
    ordered = [name for name in signals if name in names]
    return [CHECKS["axes of the car"].fault(*ordered, witnesses=witnesses), *remaining]


def _without(signals: Signals, faults: Sequence[Fault]) -> Signals:
    """Return the signals that no fault names."""
    faulty = {name for fault in faults for name in fault.signals}
    return {name: values for name, values in signals.items() if name not in faulty}


def _without_change(catalog: SignalCatalog, signals: Signals) -> Iterator[Fault]:
    for name, values in signals.items():
        present = values[np.isfinite(values)]
        if not present.size:
            yield CHECKS["no value"].fault(name)
        elif present.size >= MIN_TICKS and present.min() == present.max():
            value = f": {present[0]:g} {catalog[name].unit}"
            yield CHECKS["constant signal"].fault(name, value=value)


# Signals that stay on one side of zero, though the car turns to both sides. Some buses send the
# magnitude of a rate or an angle, and its sign as a bit of its own.

MIN_ONE_SIDED_S = 60.0
"""In a shorter drive a car may turn to one side."""


def find_one_sided(signals: Signals, moving: BoolArray, label: str) -> Iterator[Fault]:
    """Yield signals that never change their sign while the car drives; the label comes last.

    A car that does turn to one side, as on an oval, shows it by its rear wheels, or by the mean of
    the other signs of turning.
    """
    rear = ("wheel_rl", "wheel_rr")
    if set(rear) <= set(signals) and _side(signals[rear[1]] - signals[rear[0]], moving):
        return
    means = {name: _mean_ratio(signals[name], moving) for name in SIGNED if name in signals}
    for name in (*SIGNED, label):
        if name not in signals or not (side := _side(signals[name], moving)):
            continue
        ratios = [mean for other, mean in means.items() if other != name]
        if ratios and np.median(ratios) > MIN_MEAN_RATIO:
            continue
        sign, minutes = ("negative" if side > 0 else "positive"), signals[name].size / 6000
        check = CHECKS["lost sign of the label" if name == label else "lost sign"]
        yield check.fault(name, evidence=f"it is never {sign} in {minutes:.0f} min")


def _mean_ratio(values: FloatArray, rows: BoolArray) -> float:
    """Return the magnitude of the mean over the root mean square; 0 without values."""
    present = values[np.isfinite(values) & rows]
    square = float(np.mean(present**2)) if present.size else 0.0
    return abs(float(present.mean())) / math.sqrt(square) if square > 0 else 0.0


def _side(values: FloatArray, rows: BoolArray) -> int:
    """Return +1 or -1 for values on one side of zero alone, 0 for others, or too few."""
    present = values[np.isfinite(values) & rows]
    if present.size * float(SAMPLE_TIME_S) < MIN_ONE_SIDED_S:
        return 0
    low, high = np.quantile(present, [0.001, 0.999])
    if max(-low, high) <= 0:
        return 0
    if low >= -CHECKS["lost sign"].low * high:
        return 1
    return -1 if high <= -CHECKS["lost sign"].low * low else 0


def _turning(signals: Signals, moving: BoolArray, label: str) -> list[Fault]:
    """Compare the signs of turning, and both accelerations with the turns, while the car moves."""
    names = {"ax", *(name for parts in WITNESSES.values() for name in parts)}
    used = {name: values for name, values in signals.items() if name in names}
    if not used:
        return []
    rows = moving & np.isfinite(list(used.values())).all(axis=0)
    if rows.sum() < MIN_TICKS:
        return []
    moments = MeanMoments.from_rows(used, rows)
    faults = find_reversed_or_swapped(moments).get(0, [])
    if faults and set(faults[0].signals) == {"ay", "yaw_rate"}:
        faults = [_decide(faults[0], signals, moving, label)]
    return [*faults, *find_swapped_axes(moments).values()]


def _decide(fault: Fault, signals: Signals, moving: BoolArray, label: str) -> Fault:
    """Return which one of ay and yaw rate contradicts the label, too; the fault if none does."""
    reversed_ = is_yaw_rate_reversed(label, signals, moving)
    if reversed_ is None:
        return fault
    return Fault(
        fault.kind,
        ("yaw_rate",) if reversed_ else ("ay",),
        f"it contradicts both {'ay' if reversed_ else 'yaw_rate'} and {label}",
        "Write negate = true.",
    )


# The size of signals by that of others.

STEERING_RATIO = 15.0
ROAD_WHEELS = ("steer_fl", "steer")


def _ratio(values: FloatArray, expected: FloatArray, rows: BoolArray) -> float | None:
    """Return the median of values over expected; None of too few, or where one does not move."""
    rows = rows & np.isfinite(values) & np.isfinite(expected) & (expected != 0)
    if rows.sum() < MIN_TICKS:
        return None
    ratio = float(np.median(values[rows] / expected[rows]))
    return ratio if ratio > 0 else None


def _speeds(signals: Signals, moving: BoolArray) -> Iterator[Fault]:
    """Compare each wheel with all, and each speed with the wheels; ay and yaw rate decide."""
    wheels = wheel_speed_mps(signals)
    if wheels is None:
        return
    for name in (name for name in WHEELS if name in signals):
        ratio = _ratio(signals[name] * RADIUS_M, wheels, moving)
        if ratio:
            yield from CHECKS["speed of one wheel"].test(ratio, name, ratio=ratio)
    for name in (name for name in SPEEDS_OF_CAR if name in signals):
        is_receiver = name == SATELLITE_SPEED
        check = CHECKS["speed of the receiver" if is_receiver else "speeds of the car"]
        ratio = _ratio(signals[name], wheels, moving)
        if ratio and not check.passes(ratio):
            named = [wheel for wheel in WHEELS if wheel in signals]
            of_wheels = _turns_at(wheels, signals, moving)
            of_speed = _turns_at(signals[name], signals, moving)
            if of_wheels and not of_speed:
                named = [name]
            elif of_wheels == of_speed:
                named = [*named, name]
            yield check.fault(*named, name=name, ratio=ratio)


def _turns_at(speed: FloatArray, signals: Signals, moving: BoolArray) -> bool:
    """Return True if ay is the yaw rate times this speed."""
    if not {"ay", "yaw_rate"} <= set(signals):
        return False
    slope, correlation = slope_of(signals["ay"], signals["yaw_rate"] * speed, moving)
    return abs(correlation) > MIN_CORRELATION and CHECKS["speeds of the car"].passes(abs(slope))


def _compared(
    signals: Signals, speed: FloatArray, moving: BoolArray
) -> Iterator[tuple[tuple[str, ...], str, float, float]]:
    """Yield signals, the predictor of the first, its ratio to that, and their correlation."""
    yaw_rate, ay = signals.get("yaw_rate"), signals.get("ay")
    if yaw_rate is not None and {"wheel_rl", "wheel_rr"} <= set(signals):
        turn = (signals["wheel_rr"] - signals["wheel_rl"]) * RADIUS_M / TRACK_M
        expected = "the yaw rate of the rear wheels"
        yield ("yaw_rate",), expected, *slope_of(yaw_rate, turn, moving)
    if yaw_rate is not None and ay is not None:
        yield ("ay", "yaw_rate"), "yaw rate times speed", *slope_of(ay, yaw_rate * speed, moving)
    if "ax" in signals and speed.size >= 4 * MIN_TICKS:
        half = TICKS_PER_S // 2
        change = np.full(speed.size, np.nan)
        change[half:-half] = speed[TICKS_PER_S:] - speed[:-TICKS_PER_S]
        smooth = np.convolve(np.nan_to_num(signals["ax"]), np.ones(2 * half) / (2 * half), "same")
        yield ("ax",), "the change of speed", *slope_of(smooth, change, moving)
    wheel = signals.get("steering_wheel")
    angle = next((name for name in ROAD_WHEELS if name in signals), None)
    if wheel is not None and angle is not None:
        column = STEERING_RATIO * signals[angle]
        yield ("steering_wheel", angle), "15 times the other", *slope_of(wheel, column, moving)


def _sizes(signals: Signals, speed: FloatArray, moving: BoolArray) -> Iterator[Fault]:
    """Compare the sizes of signals with those that others predict; and the sign of `ax`."""
    for names, expected, slope, correlation in _compared(signals, speed, moving):
        ratio = slope if correlation > 0 else -slope
        if names == ("ax",) and not CHECKS["sign of ax"].passes(correlation):
            yield CHECKS["sign of ax"].fault(*names, correlation=correlation)
        elif abs(correlation) > MIN_CORRELATION:
            check = CHECKS["size of a signal"]
            yield from check.test(ratio, *names, ratio=ratio, expected=expected)


MAX_BEND_MPS, MAX_BEND_MPS2, MIN_BEND_PER_M = 12.0, 6.0, 0.05
"""Bends of 20 m and less, at a speed and yaw rate times speed at which the tyres hardly slip."""


def _axles(signals: Signals, speed: FloatArray, moving: BoolArray) -> Iterator[Fault]:
    """Compare axles in tight bends: the front one drives the longer way."""
    if not {"yaw_rate", *WHEELS} <= set(signals):
        return
    front, rear = (signals[f"wheel_{axle}l"] + signals[f"wheel_{axle}r"] for axle in "fr")
    with np.errstate(divide="ignore", invalid="ignore"):
        tightness, longer = (signals["yaw_rate"] / speed) ** 2, front / rear - 1
    rows = moving & (speed < MAX_BEND_MPS)
    rows &= np.abs(signals["yaw_rate"] * speed) < MAX_BEND_MPS2
    tightest = np.nanmax(tightness, initial=0, where=rows & np.isfinite(tightness))
    if tightest < MIN_BEND_PER_M**2:
        return
    slope, correlation = slope_of(longer, tightness, rows)
    if correlation < CHECKS["front and rear wheels"].low and slope < -1:
        yield CHECKS["front and rear wheels"].fault(*WHEELS, correlation=correlation)


# The checks of rows on some long drives of a cohort, read from the logs.

MAX_TICKS = 100_000
"""Ticks of each drive that are read: a quarter of an hour."""

_LONGEST = """
    SELECT drive_id, vehicle_id, day FROM drives WHERE source = $source AND ({predicate})
    ORDER BY row_number() OVER (PARTITION BY vehicle_id ORDER BY rows DESC, drive_id),
        rows DESC, drive_id
"""


@dataclass(frozen=True)
class InspectedDrive:
    """A drive whose rows were checked, and its harmful faults."""

    drive_id: str
    vehicle_id: str
    day: date
    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class Inspection:
    """Drives whose rows were checked.

    Attributes
    ----------
    drives
        One of each car first, the longest first.
    measured
        Number of measured drives of the cohort.
    """

    drives: tuple[InspectedDrive, ...]
    measured: int

    def by_fault(self) -> dict[tuple[str, tuple[str, ...]], list[Fault]]:
        """Return the faults of all drives by kind and signals."""
        faults: dict[tuple[str, tuple[str, ...]], list[Fault]] = {}
        for drive in self.drives:
            for fault in drive.faults:
                faults.setdefault((fault.kind, fault.signals), []).append(fault)
        return faults

    def is_systematic(self, fault: Fault) -> bool:
        """Return True if most drives have this fault, so that no drive shows the correct value."""
        drives = self.by_fault().get((fault.kind, fault.signals), [])
        return 2 * len(drives) > len(self.drives)


def inspect_drives(
    warehouse: Warehouse,
    predicate: Predicate,
    max_drives: int,
    select: Callable[[Sequence[str]], Sequence[bool]] | None = None,
) -> Inspection:
    """Check the rows of the longest measured drives of a cohort, of as many cars as possible.

    `select` returns which of the drives to consider, by their names.
    """
    signals = warehouse.catalog.signals
    query = _LONGEST.format(predicate=predicate.sql)
    with (
        connect_tables(warehouse, query + "log_counts") as database,
        guarded_query(database, predicate),
    ):
        drives = database.execute(query, {"source": MEASURED}).fetchall()
        measured = len(drives)
        if select is not None:
            selected = select([drive for drive, *_ in drives])
            drives = [drive for drive, use in zip(drives, selected, strict=True) if use]
        inspected = []
        for drive, vehicle, day in drives[:max_drives]:
            columns = database.execute(
                "SELECT * FROM log_counts WHERE day = $day AND drive_id = $drive ORDER BY tick "
                f"LIMIT {MAX_TICKS}",
                {"day": day, "drive": drive},
            ).fetchnumpy()
            faults = check_plausibility(signals, _signals_of(signals, columns))
            harmful = tuple(fault for fault in faults if fault.does_harm)
            inspected.append(InspectedDrive(drive, vehicle, day, harmful))
    return Inspection(tuple(inspected), measured)


def _signals_of(signals: SignalCatalog, columns: Mapping[str, Any]) -> Signals:
    """Return the signals of a drive that have values."""
    counts = {
        name: np.ma.filled(np.ma.asarray(columns[name], dtype=np.float64), np.nan)
        for name in signals.signals
        if name in columns
    }
    present = {name: values for name, values in counts.items() if np.isfinite(values).any()}
    return to_regular_grid(signals, np.asarray(columns["tick"], dtype=np.int32), present)
