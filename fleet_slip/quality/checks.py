"""The list of checks for faulty sensors and labels, and the faults that they report.

`ingest` runs the checks of a log and of the rows of its drives. `quality`, `publish` and `nightly`
run those of the rows of some drives, and of the Gram rows of all. A threshold stands here alone:
the check that uses it reads it from the list, its message shows it, and docs/quality.md lists it.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import inf
from typing import Any

KINDS = {
    "absent": "no sign in",
    "cars": "several cars in",
    "no slip": "no slip in",
    "place": "misplaced",
    "time": "unknown",
    "values": "wrong values of",
}
"""Words before the signals of a fault, where these are not its kind."""


@dataclass(frozen=True)
class Fault:
    """A relation that a drive or a log contradicts.

    Attributes
    ----------
    kind
        Such as stuck, reversed, swapped, scaled, biased, late; see `CHECKS`.
    signals
        Those in doubt.
    figure
        The evidence.
    remedy
        What to change in the mapping, or what to do.
    """

    kind: str
    signals: tuple[str, ...]
    figure: str
    remedy: str = ""

    def __str__(self) -> str:
        """Return one line."""
        kind = KINDS.get(self.kind, self.kind)
        return f"{kind} {', '.join(self.signals)}? {self.figure}. {self.remedy}"

    @property
    def does_harm(self) -> bool:
        """Return False for a fault that learning corrects."""
        return self.kind != "scale"


class Scope(StrEnum):
    """Scope of a comparison."""

    ROW = "row"
    """Rows of a log, each by itself or with the next."""
    DRIVE = "drive"
    """Signals of a drive with one another."""
    PEERS = "peers"
    """A drive with other drives and cars."""
    LABEL = "label"
    """The label with the motion of the car, or with the labels of other drives."""


class Data(StrEnum):
    """Data that a check reads."""

    LOG = "log"
    """A log, while it is read: `ingest`."""
    ROWS = "rows"
    """Rows of a drive: `ingest`; of some drives `quality`, `publish` and `nightly`."""
    GRAMS = "Gram rows"
    """Gram rows of all drives: `quality`, `publish` and `nightly`."""


@dataclass(frozen=True)
class Check:
    """A relation that sound data satisfy.

    Attributes
    ----------
    name
        Unique.
    kind
        Of the faults that it reports.
    scope
        What it compares.
    data
        What it reads.
    message
        Evidence of a fault, with fields for figures; {low} and {high} are the threshold.
    threshold
        Lowest and highest value of sound data.
    unit
        Of the threshold.
    remedy
        What to change.
    source
        Where the threshold is from, if not from here.
    """

    name: str
    kind: str
    scope: Scope
    data: tuple[Data, ...]
    message: str
    threshold: tuple[float, float] = (-inf, inf)
    unit: str = ""
    remedy: str = ""
    source: str = ""

    @property
    def low(self) -> float:
        """Return the lowest sound value."""
        return self.threshold[0]

    @property
    def high(self) -> float:
        """Return the highest sound value."""
        return self.threshold[1]

    def fault(self, *signals: str, **figures: Any) -> Fault:
        """Return a fault of signals; `low` and `high` among the figures narrow the threshold."""
        values = {"low": self.low, "high": self.high, **figures}
        return Fault(
            self.kind, signals, self.message.format(**values), self.remedy.format(**values)
        )


LOG, ROWS, GRAMS, BOTH = (Data.LOG,), (Data.ROWS,), (Data.GRAMS,), (Data.ROWS, Data.GRAMS)
ROW, DRIVE, PEERS, LABEL = Scope.ROW, Scope.DRIVE, Scope.PEERS, Scope.LABEL
NEGATE, SWAP, UNITS = "Write negate = true.", "Swap their columns.", "Check the units."
MAP_ANOTHER = "Map another column."
MONITOR = "`{}` in `configs/monitor.toml`"

# Rows of a log.

_REFUSED = "{count:,} of {rows:,} rows were refused: {reason}"
_TENTH = (-inf, 0.1)
# fmt: off
REFUSED_RANGE = Check(
    "values out of range", "scaled", ROW, LOG, _REFUSED, _TENTH, "of the rows", "Check its unit.")
REFUSED_TEXTS = Check(
    "texts in place of numbers", "texts", ROW, LOG, _REFUSED, _TENTH, "of the rows",
    "Name those that mean no value under missing.")
REFUSED_INFINITE = Check(
    "values that are not finite", "values", ROW, LOG, _REFUSED, _TENTH, "of the rows",
    'Write missing = ["nan"] if they mean no value.')
REFUSED_VALUES = Check(
    "refused values", "values", ROW, LOG, _REFUSED, _TENTH, "of the rows", "Look at the column.")
REFUSED_TIMES = Check(
    "refused times", "values", ROW, LOG,
    "{count:,} of {rows:,} rows were refused, {most:,} of them: {reason}", _TENTH, "of the rows",
    "Check the column of times, its unit and its format{mixed}.")
MANY_REFUSED = Check(
    "refused rows", "values", ROW, LOG,
    "{count:,} of {rows:,} rows were refused, {most:,} of them: {reason}", _TENTH, "of the rows",
    "Look at the view quarantine.")
OVERLAPPING_ROWS = Check(
    "one car twice at a time", "repeated", ROW, LOG,
    "drives of one car overlap in time ({count:,} times)", (-inf, 1.0), "s",
    "Set vehicle_id or drive.column.")
UNUSED_CARS = Check(
    "unused column of cars or trips", "cars", ROW, LOG,
    "it has {count:,} values, and the mapping does not use it", (-inf, 1), "value",
    "Write {where} under [drive].")
ASSUMED_RATE = Check(
    "assumed rate", "time", ROW, LOG, "the log has no time column; {rate_hz:g} Hz is assumed",
    remedy="Set the true rate_hz and remove assumed = true.")

# Signals of a drive with one another. Each check passes over signals that an earlier one named.

_TURNING = "correlation {correlation:+.2f} with the other signs of turning"
NO_VALUE = Check(
    "no value", "absent", DRIVE, ROWS, "it has no value at all", remedy=MAP_ANOTHER)
CONSTANT = Check(
    "constant signal", "stuck", DRIVE, BOTH, "it is constant{value}", remedy=MAP_ANOTHER)
# Noise and zero points reach 2 % of the largest value on the other side.
ONE_SIDED = Check(
    "lost sign", "magnitude", DRIVE, BOTH, "{evidence}", (0.02, inf),
    "of the largest value, on the other side",
    'Where another column has its sign: sign = {{ column = "..." }}.')
TURNING_SIGN = Check(
    "sign of turning", "reversed", DRIVE, BOTH, _TURNING, (-0.3, inf), "median correlation",
    NEGATE, MONITOR.format("min_correlation"))
CONTRADICTION = Check(
    "contradicting signs", "reversed", DRIVE, ROWS,
    "they contradict each other (correlation {correlation:+.2f}): one of them is reversed",
    (-0.3, inf), "correlation", "Write negate = true for the reversed one.")
SWAPPED_WHEELS = Check(
    "left and right wheel", "swapped", DRIVE, BOTH, _TURNING, (-0.3, inf), "median correlation",
    "Swap their columns.{others}", MONITOR.format("min_correlation"))
# The one of ax and ay that follows the turns has more than 0.8, the other less than 0.5.
SWAPPED_AXES = Check(
    "axes of the accelerometer", "swapped", DRIVE, BOTH,
    "correlation with the turns: ax {ax:.2f}, ay {ay:.2f}", (0.5, 0.8),
    "correlation of ay, of ax", SWAP)
# Track over wheelbase is 0.5 to 0.65 in a car; less if steering is nearer to parallel.
SWAPPED_STEERING = Check(
    "left and right road wheel", "swapped", DRIVE, GRAMS,
    "inner wheel over outer {ratio:+.2f}, not +0.5", (-0.25, inf),
    "track over wheelbase, by Ackermann", SWAP)
SATURATED = Check(
    "saturation", "saturated", DRIVE, GRAMS, "{count:,} values at the end of their range",
    remedy="Choose a sensor of a wider range.", source=MONITOR.format("max_saturated_per_row"))
# Yaw inertia, tyres and roll delay signs of turning by up to 0.2 s, buses by up to 0.1 s.
SIGNAL_DELAY = Check(
    "delay of a signal", "late", DRIVE, ROWS,
    "it is {delay_s:+.2f} s late, with a standard error of {error_s:.2f} s, by the other signs of "
    "turning", (-0.3, 0.3), "s, and 4 standard errors", "Add {delay_s:.2f} to its delay_s.")
MUTUAL_DELAY = Check(
    "delay between two signals", "late", DRIVE, ROWS,
    "the first is {delay_s:+.2f} s later than the second, with a standard error of {error_s:.2f} s",
    (-0.3, 0.3), "s, and 4 standard errors", "Correct the delay_s of the wrong one.")
WHEEL_SPEED = Check(
    "speed of one wheel", "scaled", DRIVE, ROWS,
    "it is {ratio:.3g} times the median speed of the wheels{hint}", (0.7, 1.4), "times", UNITS)
SPEEDS = Check(
    "speeds of the car", "scaled", DRIVE, ROWS,
    "{name} is {ratio:.3g} times the speed of the wheels{hint}", (0.7, 1.4),
    "times, with wheels of 0.31 m", UNITS)
SATELLITE_SPEEDS = Check(
    "speed of the receiver", "scaled", DRIVE, ROWS,
    "{name} is {ratio:.3g} times the speed of the wheels{hint}", (0.8, 1.25),
    "times, with wheels of 0.31 m", UNITS)
# Units differ by a factor of 3.6, 9.8 or 57; radius, track and roll change less than 2.5.
SIZE = Check(
    "size of a signal", "scaled", DRIVE, ROWS, "it is {ratio:.3g} times {expected}{hint}",
    (0.4, 2.5), "times what others predict", UNITS)
LONGITUDINAL_SIGN = Check(
    "sign of ax", "reversed", DRIVE, ROWS,
    "its correlation with the change of speed is {correlation:+.2f}", (-0.6, inf), "correlation",
    NEGATE)
SWAPPED_AXLES = Check(
    "front and rear wheels", "swapped", DRIVE, ROWS,
    "in tight bends the front wheels are slower (correlation {correlation:+.2f})", (-0.6, inf),
    "correlation", "Swap the front columns with the rear ones.")
COURSE_SIZE = Check(
    "unit of the course", "scaled", DRIVE, ROWS,
    "over 1 s it changes by {scale:+.2f} times the integral of the yaw rate", (0.8, 1.25),
    "times", "Check its unit, and that of the yaw rate.")
COURSE_UNRELATED = Check(
    "course of another car", "values", DRIVE, ROWS,
    "its change over 1 s hardly correlates with the yaw rate ({correlation:+.2f})", (0.6, inf),
    "correlation", "Is it a course over ground, and of this car?")
COURSE_REPEATS = Check(
    "repeated fixes", "values", DRIVE, ROWS,
    "{share:.0%} of its fixes repeat the last in a turn, or are from reversing", _TENTH,
    "of the fixes", "They are left out. Map it as the receiver reports it.")
COURSE_SENSE = Check(
    "sense of the course", "reversed", DRIVE, BOTH,
    "it turns {scale:+.2f} times as fast as the yaw rate", (-0.5, inf), "times",
    "Invert clockwise_from_north, or swap north and east.")
COURSE_STILL = Check(
    "course that stands still", "stuck", DRIVE, BOTH,
    "it turns {scale:+.2f} times as fast as the yaw rate", (0.35, inf), "times",
    "Map the course that moves.")
# At the limit of grip much is left that the relation does not explain, but not nearly all.
COURSE_NOISE = Check(
    "noise of the course", "noisy", DRIVE, BOTH,
    "fixes have a lateral error of {noise_mps:.2f} m/s", (-inf, 0.25),
    "m/s; 0.8 m/s where the relation explains 0.15 of the changes",
    "Reflected signals? Exclude doubtful fixes with where.")
COURSE_SCALE = Check(
    "scale of the course", "scaled", DRIVE, BOTH,
    "the course turns {scale:.2f} times as fast as the yaw rate", (0.9, 1.1), "times",
    "Check both units, and the gyroscope.")
COURSE_SLIP = Check(
    "heading in place of a course", "no slip", DRIVE, BOTH,
    "beyond the yaw rate it changes by {slip:.2f} times what a car slips", (0.3, inf),
    "times, with 2 standard errors",
    "It is a heading, of a compass or the car: map the course over ground.")
# From a small car with the engine behind to a van.
COURSE_PLACE = Check(
    "place of the antenna", "place", DRIVE, ROWS,
    "it fits a point {lever_m:+.1f} m forward of the rear axle; the centre of gravity of a car is "
    "{low:g} to {high:g} m forward of it", (0.6, 2.6), "m",
    "Check antenna_x_m, delay_s, and whether the car drove backwards.")
GYROSCOPE_SCALE = Check(
    "scale of the gyroscope", "scale", DRIVE, ROWS,
    "it changes by {scale:.3f} times the integral of the yaw rate", (0.98, 1.02), "times",
    "The scale of the gyroscope is off; learning corrects it.")

# The label with the motion of the car. In gentle turns it is the distance to the rear axle times
# the yaw rate over the speed, less what the rear tyres slip (Milliken and Milliken, Race Car
# Vehicle Dynamics, chapter 5).

_LEVER = (
    "in slow turns it is {lever_m:+.2f} m times the curvature, should be {low:+.2g} to "
    "{high:+.3g} m"
)
LABEL_MAGNITUDE = Check(
    "size of the label", "scaled", LABEL, ROWS,
    "its median magnitude above 8 m/s is {median_deg:.0f} deg, should be below {high:g} deg",
    (-inf, 30.0), "deg, above 8 m/s", "Check its unit: degrees or radians?")
# Its delay has the same causes as that of a signal.
LABEL_DELAY = Check(
    "delay of the label", "late", LABEL, ROWS,
    "it is {delay_s:+.2f} s late, with a standard error of {error_s:.2f} s, by yaw rate over speed "
    "and ay", (-0.3, 0.3), "s, and 4 standard errors", "Add {delay_s:.2f} to {delayed}.")
LABEL_SIGN = Check(
    "sign of the label", "reversed", LABEL, ROWS, _LEVER, (-0.3, inf), "m", "{negate}")
# From a small car with the engine behind to a van.
LABEL_SCALE = Check(
    "scale of the label", "scaled", LABEL, ROWS, _LEVER, (0.6, 2.6),
    "m; at most 0.75 of the wheelbase that road wheels show",
    "Check {units}, and where its sensor is: sensor_x_m.")
# Real cars have up to 0.4 deg, from a sensor that is not aligned and from roads that lean.
LABEL_ZERO = Check(
    "zero of the label", "biased", LABEL, ROWS,
    "on a straight it is {zero_deg:+.2f} deg, should be {low:g} to {high:g} deg", (-0.7, 0.7),
    "deg", "Write offset = {offset_rad:.4f} (rad).")
LABEL_ONE_SIDED = Check(
    "lost sign of the label", "magnitude", LABEL, ROWS, "{evidence}", ONE_SIDED.threshold,
    ONE_SIDED.unit, ONE_SIDED.remedy)

# The label with labels of other drives. Within one drive, car, tyres and road hide a factor of 1.4.

LABEL_GAIN_SIGN = Check(
    "sign among labels", "reversed", LABEL, GRAMS,
    "gain {gain:.3f} on the prediction from others", (-0.5, inf), "gain", NEGATE)
# 0.77 where all cars are laden.
LABEL_GAIN = Check(
    "scale of a day or file", "scaled", LABEL, GRAMS, "gain {gain:.3f} of that of other {others}",
    (1 / 1.4, 1.4), "times, and `limit` standard errors; its square for one drive",
    "Check its unit.", MONITOR.format("limit"))
# 0.1 deg on ice and with load.
LABEL_OFFSET = Check(
    "zero of a day or file", "biased", LABEL, GRAMS,
    "offset {offset:+.1f} counts from that of other {others}", (-0.4, 0.4),
    "deg, and `limit` standard errors; twice for one drive", "Check its zero.",
    MONITOR.format("limit"))

# A drive with other drives of its car and of its vehicle model.

REPEATED = Check(
    "drives at once", "repeated", PEERS, GRAMS, "{overlap_s:.0f} s overlap with {other}",
    (-inf, 1.0), "s; clocks of two loggers differ by less", "Forget one of them.")
_LIMIT = MONITOR.format("limit")
EXCHANGED = Check(
    "exchanged signals", "swapped", PEERS, GRAMS, "exchanged, they match other drives",
    remedy=SWAP, source=_LIMIT)
PEERS_SIGN = Check(
    "sign among drives", "reversed", PEERS, GRAMS, "gain {gain:.3f}", (-0.5, inf), "gain",
    NEGATE, _LIMIT)
PEERS_NOISE = Check(
    "noise among drives", "noisy", PEERS, GRAMS,
    "{noise:.1f} times the usual noise, gain {gain:.3f}", remedy="Check the sensor.",
    source=_LIMIT)
PEERS_SCALE = Check(
    "scale among drives", "scaled", PEERS, GRAMS, "gain {gain:.4f}", remedy="Check its factor.",
    source=_LIMIT)
PEERS_OFFSET = Check(
    "offset among drives", "biased", PEERS, GRAMS, "offset {offset:+.1f} counts",
    remedy="Check its zero.", source=_LIMIT)
UNEXPLAINED = Check(
    "several signals", "unexplained", PEERS, GRAMS,
    "{score:.1f} standard deviations from other drives", remedy="Check the sensors of the drive.",
    source=_LIMIT)
# fmt: on

CHECKS = (
    REFUSED_RANGE,
    REFUSED_TEXTS,
    REFUSED_INFINITE,
    REFUSED_VALUES,
    REFUSED_TIMES,
    MANY_REFUSED,
    OVERLAPPING_ROWS,
    UNUSED_CARS,
    ASSUMED_RATE,
    NO_VALUE,
    CONSTANT,
    ONE_SIDED,
    TURNING_SIGN,
    CONTRADICTION,
    SWAPPED_WHEELS,
    SWAPPED_AXES,
    SWAPPED_STEERING,
    SATURATED,
    SIGNAL_DELAY,
    MUTUAL_DELAY,
    WHEEL_SPEED,
    SPEEDS,
    SATELLITE_SPEEDS,
    SIZE,
    LONGITUDINAL_SIGN,
    SWAPPED_AXLES,
    COURSE_SIZE,
    COURSE_UNRELATED,
    COURSE_REPEATS,
    COURSE_SENSE,
    COURSE_STILL,
    COURSE_NOISE,
    COURSE_SCALE,
    COURSE_SLIP,
    COURSE_PLACE,
    GYROSCOPE_SCALE,
    LABEL_MAGNITUDE,
    LABEL_DELAY,
    LABEL_SIGN,
    LABEL_SCALE,
    LABEL_ZERO,
    LABEL_ONE_SIDED,
    LABEL_GAIN_SIGN,
    LABEL_GAIN,
    LABEL_OFFSET,
    REPEATED,
    EXCHANGED,
    PEERS_SIGN,
    PEERS_NOISE,
    PEERS_SCALE,
    PEERS_OFFSET,
    UNEXPLAINED,
)
"""All checks, in the order in which they run."""
