"""Guesses which channel is which signal, by its name, its unit and its values.

Every guess has its reasons as texts, for a person to correct.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.drafting.profile import Profile
from fleet_slip.ingest.drives.suspicion import RADIUS_M
from fleet_slip.ingest.mapping.signal_column import COURSE, SPEED, Component
from fleet_slip.ingest.mapping.units import conversion_factor

NAMES: dict[str, tuple[str, ...]] = {
    "ax": ("ax", "a x", "acc x", "accel x", "long acc", "long accel", "laengs beschl"),
    "ay": ("ay", "a y", "acc y", "accel y", "lat acc", "lat accel", "quer beschl"),
    "yaw_rate": ("yaw rate", "yawrate", "yaw vel", "gyro z", "omega z", "angular vel z", "gier"),
    "steering_wheel": (
        "steering wheel", "steer wheel", "sw pos", "sw ang", "swa", "lenkrad", "lwi",
        "steering ang", "steer ang", "hand wheel",
    ),
    "sideslip": ("side slip", "sideslip", "slip angle", "beta", "schwimm", "correvit ang"),
    "vx": ("vx", "v x", "vel x", "speed x", "long vel", "vel long"),
    "vy": ("vy", "v y", "vel y", "speed y", "lat vel", "vel lat"),
    "steer": ("road wheel ang", "front wheel ang", "wheel steer ang", "steer front", "delta f"),
    "vehicle_speed": ("vehicle speed", "veh speed", "veh spd", "speed", "fahrzeug geschw"),
    "roll_rate": ("roll rate", "rollrate", "gyro x", "omega x", "angular vel x", "wank"),
    "brake_pressure": ("brake press", "brk press", "brake pres", "master cylinder", "brems druck"),
    "throttle": ("throttle", "accel pedal", "gas pedal", "fahrpedal", "drosselklappe"),
    "gear": ("gear", "gang"),
    "course": ("course", "cog", "track angle", "heading motion", "head mot", "kurs"),
    "satellite_speed": (
        "gps speed", "gnss speed", "gps vel", "gnss vel", "ground speed", "speed over ground",
        "sog", "speed 2d", "gspeed", "g speed", "gps geschw",
    ),
    "north": (
        "vel north", "speed north", "v north", "vn", "vel n", "north vel", "north speed",
        "geschw nord",
    ),
    "east": (
        "vel east", "speed east", "v east", "ve", "vel e", "east vel", "east speed", "geschw ost",
    ),
}  # fmt: skip
"""Words by which a signal is called, each at the beginning of a part of the name."""
HEADINGS = ("heading", "hdg", "track", "bearing", "yaw ang", "azimuth", "fahrt richtung")
"""Words for where a car points, or goes: which of the two, people must say."""
_NOT_NAMES = {
    "vx": ("angular", "ned", "enu"),
    "vy": ("angular", "ned", "enu"),
    "vehicle_speed": (
        "wheel", "whl", "engine", "motor", "wind", "fan", "turbo", "rad", "x", "y", "z", "east",
        "north", "up", "down", "nord", "ost", "n", "e", "lateral", "vertical", "limit",
    ),
    "gear": ("ratio", "box", "torque", "temp"),
    "steer": ("rear", "rate", "vel", "speed"),
    "course": ("std", "acc", "accuracy", "error", "rate"),
    "satellite_speed": (
        "std", "acc", "accuracy", "error", "x", "y", "z", "east", "north", "up", "down",
        "n", "e", "d", "nord", "ost",
    ),
    "north": ("std", "acc", "accuracy", "error"),
    "east": ("std", "acc", "accuracy", "error"),
}  # fmt: skip
"""Words that say that something else is called so."""
_CORNERS = {
    "fl": ("fl", "vl", "lf", "front left"),
    "fr": ("fr", "vr", "rf", "front right"),
    "rl": ("rl", "hl", "lr", "rear left"),
    "rr": ("rr", "hr", "rear right"),
}
_WHEEL_WORDS = ("wheel", "whl", "vel", "speed", "spd", "omega", "rad", "rpm", "n")
for _corner, _aliases in _CORNERS.items():
    NAMES[f"wheel_{_corner}"] = tuple(f"{w} {a}" for w in _WHEEL_WORDS for a in _aliases)
for _corner in ("fl", "fr"):
    NAMES[f"steer_{_corner}"] = tuple(f"steer {a}" for a in _CORNERS[_corner])

NO_UNIT = "the file has no unit"
OTHER_UNITS = {
    "g": "m/s^2",
    "m/s^2": "g",
    "deg": "rad",
    "rad": "deg",
    "deg/s": "rad/s",
    "rad/s": "deg/s",
    "m/s": "km/h",
    "km/h": "m/s",
}
"""What else values without a unit may be in."""

_PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_UNITS = {
    "m/s²": "m/s^2", "m/s2": "m/s^2", "m/s^2": "m/s^2", "m/s/s": "m/s^2", "mps2": "m/s^2",
    "g": "g", "°/s": "deg/s", "deg/s": "deg/s", "dps": "deg/s", "degps": "deg/s",
    "rad/s": "rad/s", "radps": "rad/s", "°": "deg", "deg": "deg", "degree": "deg",
    "degrees": "deg", "rad": "rad", "km/h": "km/h", "kmh": "km/h", "kph": "km/h",
    "m/s": "m/s", "mps": "m/s", "mph": "mph", "rpm": "rpm", "1/min": "rpm", "u/min": "rpm",
    "bar": "bar", "kpa": "kPa", "mpa": "MPa", "pa": "Pa", "psi": "psi", "%": "%", "1": "1",
}  # fmt: skip
_SUFFIXES = (
    (r"m_?p?s_?\^?2", "m/s^2"), (r"deg_?p?_?s", "deg/s"), (r"dps", "deg/s"),
    (r"rad_?p?_?s", "rad/s"), (r"km_?p?h|kph", "km/h"), (r"mps|m_s", "m/s"), (r"rpm", "rpm"),
    (r"deg", "deg"), (r"rad", "rad"), (r"g", "g"),
)  # fmt: skip


@dataclass(frozen=True)
class Guess:
    """A channel as a signal."""

    signal: str
    profile: Profile
    unit: str
    reasons: tuple[str, ...]
    """Why, for people."""
    radius_m: float | None = None
    negate: bool = False
    component: Component | None = None
    clockwise_from_north: bool | None = None

    @property
    def is_without_unit(self) -> bool:
        """Whether nothing but the values tell the unit."""
        return any(reason.startswith(NO_UNIT) for reason in self.reasons)

    def because(self, reason: str, **changes: object) -> "Guess":
        """Return the guess changed, with one more reason."""
        changed: Guess = replace(self, reasons=(*self.reasons, reason), **changes)  # type: ignore[arg-type]
        return changed


def guess_signals(profiles: tuple[Profile, ...]) -> dict[str, Guess]:
    """Return the best guess for each signal that has one; a channel is one signal at most."""
    scored = [(_score(words, p.channel.name), s, words, p) for s, words, p in _pairs(profiles)]
    scored.sort(key=lambda one: -one[0])
    guesses: dict[str, Guess] = {}
    taken: set[str] = set()
    for score, signal, words, profile in scored:
        if not score or signal in guesses or profile.channel.name in taken:
            continue
        guess = _guess(signal, profile, words)
        if guess is not None:
            guesses[signal] = guess
            taken.add(profile.channel.name)
    guesses = _satellites(guesses)
    return {name: guesses[name] for name in catalogue().signals if name in guesses}


def _satellites(guesses: dict[str, Guess]) -> dict[str, Guess]:
    """Return the guesses with the course as a mapping has it, or without it."""
    found = dict(guesses)
    north, east = found.pop("north", None), found.pop("east", None)
    course, speed = found.get(COURSE), found.get(SPEED)
    if north and east and north.unit == east.unit:
        found[COURSE] = replace(north, signal=COURSE, component="north")
        found[SPEED] = replace(east, signal=SPEED, component="east")
    elif course and speed:
        told = "clockwise from north, as receivers tell it"
        found[COURSE] = course.because(told, clockwise_from_north=True)
    if "yaw_rate" not in found or not {COURSE, SPEED} <= set(found):
        found.pop(COURSE, None)
        alone = found.pop(SPEED, None)
        if alone and not alone.component:
            found.setdefault("vehicle_speed", replace(alone, signal="vehicle_speed"))
    return found


def headings(profiles: tuple[Profile, ...], taken: set[str]) -> list[str]:
    """Return the channels that are a heading or a course, whichever."""
    return [
        p.channel.name
        for p in profiles
        if p.is_number
        and p.channel.name not in taken
        and any(_score(words, p.channel.name) for words in HEADINGS)
        and not set(_NOT_NAMES["course"]) & set(parts_of(p.channel.name))
    ]


def guess_unnamed_wheels(profiles: tuple[Profile, ...], taken: set[str]) -> list[Guess]:
    """Return four channels that are called wheels without a place, in the file's order, or none."""
    found = [
        p
        for p in profiles
        if p.is_number
        and p.channel.name not in taken
        and {"wheel", "whl"} & {part[:5] for part in parts_of(p.channel.name)}
    ]
    corners = ("fl", "fr", "rl", "rr")
    guesses = [_guess(f"wheel_{c}", p, "wheel") for c, p in zip(corners, found, strict=False)]
    return [g for g in guesses if g] if len(found) == 4 and all(guesses) else []


def parts_of(name: str) -> list[str]:
    """Return the parts of a name, in lower case: WhlSpdFL is whl, spd, fl."""
    return [part.lower() for part in _PARTS.findall(name)]


def unit_of(profile: Profile) -> str | None:
    """Return the unit that a channel has or that its name ends in, as a mapping writes it."""
    told = profile.channel.unit.strip().lower()
    if told in _UNITS:
        return _UNITS[told]
    name = profile.channel.name.lower()
    return next((u for end, u in _SUFFIXES if re.search(rf"[_\W](?:{end})$", name)), None)


def _pairs(profiles: tuple[Profile, ...]) -> Iterator[tuple[str, str, Profile]]:
    for profile in profiles:
        if profile.is_number and profile.channel.name.isprintable():
            for signal, called in NAMES.items():
                best = max(called, key=lambda words: _score(words, profile.channel.name))
                if not set(_NOT_NAMES.get(signal, ())) & set(parts_of(profile.channel.name)):
                    yield signal, best, profile


def _score(words: str, name: str) -> int:
    """Return how many letters of the words begin parts of a name; 0 unless all do."""
    parts, score = parts_of(name), 0
    for word in words.split():
        fitting = [p for p in parts if p == word or (len(word) > 2 and p.startswith(word))]
        if not fitting:
            return 0
        score += len(word)
    return score


def _guess(signal: str, profile: Profile, words: str) -> Guess | None:
    """Return a guess with a unit that the signal can have, or None."""
    si_unit = "m/s" if signal in {"north", "east"} else catalogue()[signal].unit
    named = f"its name has {words!r}"
    told = unit_of(profile)
    for unit, radius_m in ((told, None), (told, RADIUS_M)):
        measures = si_unit if radius_m is None else "m/s"
        if unit is None or (radius_m is not None and not signal.startswith("wheel_")):
            continue
        try:
            conversion_factor(unit, measures)
        except ValueError:
            continue
        return Guess(signal, profile, unit, (named, f"its unit is {unit}"), radius_m)
    if told is not None:
        return None
    unit, radius_m = _unit_of_values(si_unit, signal, float(np.nanmax(np.abs(profile.values))))
    reason = f"{NO_UNIT}; values up to {np.nanmax(np.abs(profile.values)):.3g} look like {unit}"
    return Guess(signal, profile, unit, (named, reason), radius_m)


def _unit_of_values(si_unit: str, signal: str, largest: float) -> tuple[str, float | None]:
    """Return the unit that values of a car on a road are likely to have."""
    if signal.startswith("wheel_"):
        return ("rad/s", None) if largest > 110 else ("km/h", RADIUS_M)
    if signal == "gear":
        return "1", None
    likely = {
        "m/s^2": (1.3, "g", "m/s^2"),
        "rad/s": (2.5, "rad/s", "deg/s"),
        "rad": ({"steering_wheel": 14.0, COURSE: 6.3}.get(signal, 0.9), "rad", "deg"),
        "m/s": (70.0, "m/s", "km/h"),
        "Pa": (400.0, "bar", "kPa"),
        "1": (1.2, "1", "%"),
    }
    limit, small, large = likely[si_unit]
    return (small if largest < limit else large), None
