"""Checks of a drive's rows by vehicle dynamics: signs, units, delays, swapped signals.

Each value is within its range. Axes and signs are ISO 8855.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from itertools import islice

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
    fit,
    is_moving,
    slope_of,
    speed_mps,
    to_regular_grid,
    wheel_speed_mps,
)
from fleet_slip.quality.turning import (
    MIN_MEAN_RATIO,
    WITNESSES,
    estimate_delay,
    find_delays,
    find_reversed_or_swapped,
    find_swapped_axes,
)
from fleet_slip.warehouse.database import Predicate, guarded_query
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.warehouse import Warehouse


@dataclass(frozen=True)
class SoundDrive:
    """Signals of a drive, the rows in which it moves, and its speed in m/s, NaN if not sound."""

    signals: Signals
    label: str
    moving: BoolArray
    speed: FloatArray = field(default_factory=lambda: np.full(1, np.nan))

    def has(self, *names: str) -> bool:
        """Return True if the drive has these signals."""
        return set(names) <= set(self.signals)

    def without(self, faults: Sequence[Fault]) -> "SoundDrive":
        """Return the drive with the signals that no fault names."""
        faulty = {name for fault in faults for name in fault.signals}
        sound = {name: values for name, values in self.signals.items() if name not in faulty}
        return replace(self, signals=sound)

    @property
    def has_speed(self) -> bool:
        """Return True if any speed is sound."""
        return bool(np.isfinite(self.speed).any())

    @property
    def curvature(self) -> FloatArray:
        """The yaw rate over the speed; the yaw rate itself without a speed."""
        yaw_rate = self.signals["yaw_rate"]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(yaw_rate / self.speed) if self.has_speed else yaw_rate


def check_plausibility(
    catalog: SignalCatalog, signals: Signals, *, from_velocities: bool = False
) -> list[Fault]:
    """Run the checks of a drive's rows; too few rows give no fault.

    Each check ignores signals that an earlier check found faulty. `from_velocities` is True if the
    label is computed from velocities, which changes its remedies.
    """
    label, faults = catalog.label, list(_without_change(catalog, signals))
    sound = SoundDrive(signals, label, np.ones(1, dtype=np.bool_)).without(faults)
    sound = replace(sound, moving=is_moving(sound.signals))
    one_sided = list(find_one_sided(sound))
    faults += (fault for fault in one_sided if label not in fault.signals)
    faults += _turning(sound.without(faults))
    faults += find_delays(sound.without(faults).signals, sound.moving)
    wrong_speeds = list(_speeds(sound))
    faults += wrong_speeds
    sound = replace(sound, speed=speed_mps(sound.without(wrong_speeds).signals))
    if sound.has_speed:
        faults += _sizes(sound.without(faults))
        faults += _axles(sound.without(faults))
    of_label = check_label(sound.without(faults), from_velocities=from_velocities)
    if one_sided and label in one_sided[-1].signals:
        # A biased label is on one side, too.
        is_biased = any(fault.kind == "biased" for fault in of_label)
        of_label = of_label if is_biased else one_sided[-1:]
    faults = _with_axes([*faults, *of_label], signals, label)
    return [*faults, *islice(check_course(sound.without(faults).signals), 1)]


_STEERING = ("steering_wheel", "steer", "steer_fl", "steer_fr")
_WHEEL_PAIRS = ({"wheel_fl", "wheel_fr"}, {"wheel_rl", "wheel_rr"})


def _with_axes(faults: list[Fault], signals: Signals, label: str) -> list[Fault]:
    """Replace the faults of each signal by one fault for axes that point down.

    Such axes reverse ay and yaw rate together. With the steering they outvote the wheels, whose
    columns then seem to be swapped at both axles.
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


def _without_change(catalog: SignalCatalog, signals: Signals) -> Iterator[Fault]:
    for name, values in signals.items():
        present = values[np.isfinite(values)]
        if not present.size:
            yield CHECKS["no value"].fault(name)
        elif present.size >= MIN_TICKS and present.min() == present.max():
            value = f": {present[0]:g} {catalog[name].unit}"
            yield CHECKS["constant signal"].fault(name, value=value)


# Signals that stay on one side of zero, though the car turns to both sides. Some buses send the
# magnitude of a rate or an angle, and its sign as a separate bit.

MIN_ONE_SIDED_S = 60.0
"""Minimum duration: in a shorter drive a car may turn to one side only."""


def find_one_sided(drive: SoundDrive) -> Iterator[Fault]:
    """Yield signals that never change their sign while the car drives; the label comes last.

    On an oval a car turns to one side only. The rear wheels, or the means of the other signals,
    reveal this, and then there is no fault.
    """
    signals, label, moving = drive.signals, drive.label, drive.moving
    rear = ("wheel_rl", "wheel_rr")
    if drive.has(*rear) and _side(signals[rear[1]] - signals[rear[0]], moving):
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
    """Return +1 or -1 for values on one side of zero, 0 for both sides or too few values."""
    present = values[np.isfinite(values) & rows]
    if present.size * float(SAMPLE_TIME_S) < MIN_ONE_SIDED_S:
        return 0
    low, high = np.quantile(present, [0.001, 0.999])
    if max(-low, high) <= 0:
        return 0
    if low >= -CHECKS["lost sign"].low * high:
        return 1
    return -1 if high <= -CHECKS["lost sign"].low * low else 0


def _turning(drive: SoundDrive) -> list[Fault]:
    """Compare the signs of turning, and the accelerations with the turns, while the car moves."""
    names = {"ax", *(name for parts in WITNESSES.values() for name in parts)}
    used = {name: values for name, values in drive.signals.items() if name in names}
    if not used:
        return []
    rows = drive.moving & np.isfinite(list(used.values())).all(axis=0)
    if rows.sum() < MIN_TICKS:
        return []
    moments = MeanMoments.from_rows(used, rows)
    faults = find_reversed_or_swapped(moments).get(0, [])
    if faults and set(faults[0].signals) == {"ay", "yaw_rate"}:
        faults = [_decide(faults[0], drive)]
    return [*faults, *find_swapped_axes(moments).values()]


def _decide(fault: Fault, drive: SoundDrive) -> Fault:
    """Return the fault of ay or yaw rate alone if the label contradicts it, too; else `fault`."""
    drive = replace(drive, speed=speed_mps(drive.signals))
    if not drive.has(drive.label, "yaw_rate", "ay"):
        return fault
    lever_m, _, explained = _fit_lever(drive.signals[drive.label], drive)
    if explained <= MIN_EXPLAINED or abs(lever_m) < -CHECKS["sign of the label"].low:
        return fault
    wrong, other = ("yaw_rate", "ay") if lever_m < 0 else ("ay", "yaw_rate")
    figure = f"it contradicts both {other} and {drive.label}"
    return Fault(fault.kind, (wrong,), figure, "Write negate = true.")


# Sizes of signals, compared with one another.

STEERING_RATIO = 15.0
ROAD_WHEELS = ("steer_fl", "steer")


def _ratio(values: FloatArray, expected: FloatArray, rows: BoolArray) -> float | None:
    """Return the median ratio of values to expected ones; None for too few or a negative ratio."""
    rows = rows & np.isfinite(values) & np.isfinite(expected) & (expected != 0)
    if rows.sum() < MIN_TICKS:
        return None
    ratio = float(np.median(values[rows] / expected[rows]))
    return ratio if ratio > 0 else None


def _speeds(drive: SoundDrive) -> Iterator[Fault]:
    """Compare each wheel with all, and each speed with the wheels; ay and yaw rate decide."""
    signals, moving = drive.signals, drive.moving
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
            of_wheels = _turns_at(wheels, drive)
            of_speed = _turns_at(signals[name], drive)
            if of_wheels and not of_speed:
                named = [name]
            elif of_wheels == of_speed:
                named = [*named, name]
            yield check.fault(*named, name=name, ratio=ratio)


def _turns_at(speed: FloatArray, drive: SoundDrive) -> bool:
    """Return True if ay is the yaw rate times this speed."""
    if not drive.has("ay", "yaw_rate"):
        return False
    expected = drive.signals["yaw_rate"] * speed
    slope, correlation = slope_of(drive.signals["ay"], expected, drive.moving)
    return abs(correlation) > MIN_CORRELATION and CHECKS["speeds of the car"].passes(abs(slope))


def _compared(drive: SoundDrive) -> Iterator[tuple[tuple[str, ...], str, float, float]]:
    """Yield signals, the name of the predictor of the first, their ratio, and their correlation."""
    signals, moving, speed = drive.signals, drive.moving, drive.speed
    yaw_rate, ay = signals.get("yaw_rate"), signals.get("ay")
    if yaw_rate is not None and drive.has("wheel_rl", "wheel_rr"):
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


def _sizes(drive: SoundDrive) -> Iterator[Fault]:
    """Compare the sizes of signals with their predictions, and the sign of `ax`."""
    for names, expected, slope, correlation in _compared(drive):
        ratio = slope if correlation > 0 else -slope
        if names == ("ax",) and not CHECKS["sign of ax"].passes(correlation):
            yield CHECKS["sign of ax"].fault(*names, correlation=correlation)
        elif abs(correlation) > MIN_CORRELATION:
            check = CHECKS["size of a signal"]
            yield from check.test(ratio, *names, ratio=ratio, expected=expected)


MAX_BEND_MPS, MAX_BEND_MPS2, MIN_BEND_PER_M = 12.0, 6.0, 0.05
"""Bends of 20 m and less, at a speed and yaw rate times speed at which the tyres hardly slip."""


def _axles(drive: SoundDrive) -> Iterator[Fault]:
    """Compare axles in tight bends: the front axle has the longer path."""
    if not drive.has("yaw_rate", *WHEELS):
        return
    signals, speed, tightness = drive.signals, drive.speed, drive.curvature**2
    front, rear = (signals[f"wheel_{axle}l"] + signals[f"wheel_{axle}r"] for axle in "fr")
    with np.errstate(divide="ignore", invalid="ignore"):
        longer = front / rear - 1
    rows = drive.moving & (speed < MAX_BEND_MPS)
    rows &= np.abs(signals["yaw_rate"] * speed) < MAX_BEND_MPS2
    tightest = np.nanmax(tightness, initial=0, where=rows & np.isfinite(tightness))
    if tightest < MIN_BEND_PER_M**2:
        return
    slope, correlation = slope_of(longer, tightness, rows)
    if correlation < CHECKS["front and rear wheels"].low and slope < -1:
        yield CHECKS["front and rear wheels"].fault(*WHEELS, correlation=correlation)


# The label and the motion of the car within one drive: size, delay, sign, scale and zero.
#
# This needs no other drive, so that it also detects a fault of all drives.

FAST_MPS, SLOW_MPS = 8.0, 20.0
"""Above the first speed a car rarely has a large angle; below the second the lever is constant."""
GENTLE_MPS2, MIN_GENTLE_TICKS = 5.0, 500
"""Maximum ay, and minimum ticks below it: beyond, tyres are not linear, so there is no lever."""
MAX_COLLINEARITY = 0.995
"""Maximum correlation of curvature and curvature times squared speed: below it, speeds differ by at
least 5 %. At one speed ay and curvature differ only in phase, and relaxing tyres bias the lever."""
SLIDING_M, SLIDING_RAD = 8.0, 0.15
"""Lever beyond that of any car, and the angle of a sliding car if it is frequent."""
MIN_EXPLAINED, MIN_SURE_EXPLAINED = 0.6, 0.85
"""Explained share of the variance to judge the sign, and to judge scale and zero."""
WHEELBASE_M, MAX_WHEELBASE_SHARE = (2.0, 4.5), 0.75
"""Wheelbases of cars, and the largest share of it between centre of gravity and rear axle."""
MAX_COMPLIANCE = 0.012
"""Side-slip of the rear axle in rad per m/s²: twice that of a usual car."""


def check_label(drive: SoundDrive, *, from_velocities: bool) -> list[Fault]:
    """Return the first fault of a label that the motion of its car shows."""
    if not drive.has(drive.label, "yaw_rate"):
        return []
    for name, figures in _contradictions(drive):
        check = CHECKS[name]
        if from_velocities:
            check = replace(check, remedy=check.remedy_of_velocities or check.remedy)
        return [check.fault(drive.label, **figures)]
    return []


def _contradictions(drive: SoundDrive) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Yield checks that the label fails, by name, and their figures."""
    signals, moving = drive.signals, drive.moving
    angle = np.where(moving, signals[drive.label], np.nan)
    large = np.abs(angle[(drive.speed > FAST_MPS) & np.isfinite(angle)])
    median_deg = float(np.degrees(np.median(large))) if large.size >= MIN_TICKS else 0.0
    if median_deg > CHECKS["size of the label"].high:
        yield "size of the label", {"median_deg": median_deg}
    inputs = np.array([drive.curvature, *([signals["ay"]] if "ay" in signals else [])])
    delay = estimate_delay(angle, inputs, moving & np.isfinite(inputs).all(axis=0))
    if delay is not None and delay.exceeds(CHECKS["delay of the label"].high):
        yield "delay of the label", {"delay_s": delay.value_s, "error_s": delay.error_s}
    if len(inputs) == 2:
        sliding = large.size >= MIN_TICKS and float(np.quantile(large, 0.9)) > SLIDING_RAD
        yield from _lever(drive, sliding=sliding)


def _gentle(drive: SoundDrive) -> BoolArray:
    """Return a mask of rows in which the car turns gently and slowly, or not at all."""
    signals, speed = drive.signals, drive.speed
    slow = (speed < SLOW_MPS) & (speed > 0) & (np.abs(signals["ay"]) < GENTLE_MPS2)
    return drive.moving & slow & np.isfinite(signals["yaw_rate"])


def _fit_lever(angle: FloatArray, drive: SoundDrive) -> tuple[float, float, float]:
    """Return the slope on the curvature in m, the constant and the explained share.

    The inputs are curvature and ay. All results are 0 if the drive has only one speed.
    """
    rows, inputs = _gentle(drive), np.array([drive.curvature, drive.signals["ay"]])
    if rows.sum() < MIN_GENTLE_TICKS or _is_one_speed(inputs[0, rows], drive.speed[rows]):
        return 0.0, 0.0, 0.0
    (lever_m, _), zero, explained = fit(angle, inputs, rows)
    return float(lever_m), zero, explained


def _is_one_speed(curvature: FloatArray, speed: FloatArray) -> bool:
    """Return True if the speed varies too little to separate curvature and ay."""
    squared = curvature * speed**2
    if not (curvature.std() > 0 and squared.std() > 0):
        return True
    return bool(abs(np.corrcoef(curvature, squared)[0, 1]) > MAX_COLLINEARITY)


def _lever(drive: SoundDrive, *, sliding: bool) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Compare the label's slope on the curvature with the levers of cars, and check its zero."""
    lever_m, zero, explained = _fit_lever(drive.signals[drive.label], drive)
    check, sign = CHECKS["scale of the label"], CHECKS["sign of the label"]
    low, high = check.low, check.high
    if explained:
        high = min(high, MAX_WHEELBASE_SHARE * _wheelbase_m(drive))
        is_reversed = explained > MIN_EXPLAINED and lever_m < sign.low
        is_large = explained > MIN_EXPLAINED and lever_m > SLIDING_M and sliding
        is_scaled = explained > MIN_SURE_EXPLAINED and not low < lever_m < high
    else:
        lever_m, mean_square, explained = _fit_one_speed(drive)
        low -= MAX_COMPLIANCE * mean_square
        is_sure = explained > MIN_SURE_EXPLAINED
        is_reversed = is_sure and lever_m < min(low, 0) + sign.low
        is_large = is_sure and lever_m > SLIDING_M
        is_scaled = is_sure and 0 < lever_m < low
    bounds = {"lever_m": lever_m, "low": low, "high": high}
    if is_reversed:
        yield "sign of the label", bounds
    if is_large or is_scaled:
        yield "scale of the label", bounds
    zero_deg = math.degrees(zero)
    if explained > MIN_SURE_EXPLAINED and not CHECKS["zero of the label"].passes(zero_deg):
        yield "zero of the label", {"zero_deg": zero_deg, "offset_rad": -zero}


def _wheelbase_m(drive: SoundDrive) -> float:
    """Return the wheelbase by the steering of the road wheels; infinity if it is unclear."""
    angle = next((drive.signals[name] for name in ROAD_WHEELS if drive.has(name)), None)
    if angle is None:
        return math.inf
    wheelbase_m, _, explained = _fit_lever(angle, drive)
    shortest, longest = WHEELBASE_M
    is_sure = explained > MIN_SURE_EXPLAINED and shortest < wheelbase_m < longest
    return wheelbase_m if is_sure else math.inf


def _fit_one_speed(drive: SoundDrive) -> tuple[float, float, float]:
    """Return the slope on the curvature in m, the mean squared speed and the explained share.

    At one speed the slope is the lever less the compliance times the squared speed.
    """
    rows = _gentle(drive)
    if rows.sum() < MIN_GENTLE_TICKS:
        return 0.0, 0.0, 0.0
    (slope,), _, explained = fit(drive.signals[drive.label], drive.curvature[None], rows)
    return float(slope), float(np.mean(drive.speed[rows] ** 2)), explained


# The checks of rows on some long drives of a cohort, read from the logs.

MAX_TICKS = 100_000
"""Maximum ticks to read of each drive: a quarter of an hour."""

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
        The longest drive of each car first, then the second longest, and so on.
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
            counts = {
                name: np.ma.filled(np.ma.asarray(columns[name], dtype=np.float64), np.nan)
                for name in signals.signals
                if name in columns and np.ma.count(columns[name])
            }
            values = to_regular_grid(signals, np.asarray(columns["tick"], np.int32), counts)
            faults = [f for f in check_plausibility(signals, values) if f.does_harm]
            inspected.append(InspectedDrive(drive, vehicle, day, tuple(faults)))
    return Inspection(tuple(inspected), measured)
