"""Guesses which channel is which signal, by its name, its unit and its values.

Every guess has its reasons as texts, for a person to correct; what speaks against it are doubts,
and with a doubt it is a question.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.drafting.profile import Profile
from fleet_slip.ingest.drives.one_sided import TURNING
from fleet_slip.ingest.drives.suspicion import RADIUS_M
from fleet_slip.ingest.mapping.signal_column import COURSE, SPEED, Component
from fleet_slip.ingest.mapping.units import conversion_factor
from fleet_slip.ingest.mapping.vocabulary import (
    CORNERS,
    best_words,
    fits_any,
    parts_of,
    split_unit,
    unit_behind,
    unit_called,
    vocabulary,
)

NO_UNIT = "the file has no unit"
_WEAK = 0.5
"""What a word that may mean something else counts against one that does not."""
_UNIT_FITS = 4.0
_SIGN_WORDS = {"vz", "vorzeichen", "sign", "signum", "sgn"}
_ALIKE = 0.02


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
    sign: tuple[str, int] | None = None
    """The column with its sign, and what stands there where it is negative."""
    is_weak: bool = False
    """Whether its name may as well mean something else."""
    doubts: tuple[str, ...] = ()
    """What speaks against it."""
    rivals: tuple["Guess", ...] = ()
    """Others that its name and unit fit as well."""

    @property
    def is_without_unit(self) -> bool:
        """Whether nothing but the values tell the unit."""
        return any(reason.startswith(NO_UNIT) for reason in self.reasons)

    def because(self, reason: str, **changes: object) -> "Guess":
        """Return the guess changed, with one more reason."""
        changed: Guess = replace(self, reasons=(*self.reasons, reason), **changes)  # type: ignore[arg-type]
        return changed

    def doubted(self, doubt: str) -> "Guess":
        """Return the guess as one that has something against it."""
        return replace(self, doubts=(*self.doubts, doubt))


def guess_signals(profiles: tuple[Profile, ...]) -> dict[str, Guess]:
    """Return the best guess for each signal that has one; a channel is one signal at most."""
    scored = [one for p in profiles if p.is_number for one in _scored(p)]
    scored.sort(key=lambda one: -one[0])
    guesses: dict[str, Guess] = {}
    best: dict[str, float] = {}
    taken: set[str] = set()
    for score, guess in scored:
        signal, name = guess.signal, guess.profile.channel.name
        if name in taken:
            continue
        if signal not in guesses:
            guesses[signal], best[signal] = guess, score
            taken.add(name)
        elif score == best[signal] and not _same_values(guess, guesses[signal]):
            first = guesses[signal]
            guesses[signal] = replace(first, rivals=(*first.rivals, guess))
    guesses = _satellites(guesses)
    signed = {name: _with_sign(guess, profiles) for name, guess in guesses.items()}
    return {name: signed[name] for name in catalogue().signals if name in signed}


def _scored(profile: Profile) -> Iterator[tuple[float, Guess]]:
    """Yield what a channel may be, with how well it fits."""
    name = profile.channel.name
    if not name.isprintable():
        return
    for signal in vocabulary()["signals"]:
        score, words = best_words(signal, name)
        weak = not score
        if weak:
            score, words = best_words(signal, name, "weak")
            score *= _WEAK
        if not score or (guess := _guess(signal, profile, words)) is None:
            continue
        fits = 0.0 if guess.is_without_unit else _UNIT_FITS
        yield score + fits, replace(guess, is_weak=weak)


def _same_values(one: Guess, other: Guess) -> bool:
    a, b = one.profile.values, other.profile.values
    if a.size != b.size:
        return False
    both = np.isfinite(a) & np.isfinite(b)
    spread = float(np.std(b[both])) if both.any() else 0.0
    return bool(both.any() and np.std(a[both] - b[both]) <= _ALIKE * max(spread, 1e-9))


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


def _with_sign(guess: Guess, profiles: tuple[Profile, ...]) -> Guess:
    """Return a magnitude with the column of its sign, where another is called so."""
    if guess.signal not in TURNING or guess.profile.range[0] < 0:
        return guess
    own = sorted(parts_of(split_unit(guess.profile.channel.name)[0]))
    for other in profiles:
        parts = parts_of(split_unit(other.channel.name)[0])
        if sorted(p for p in parts if p not in _SIGN_WORDS) != own or len(parts) == len(own):
            continue
        values = sorted({float(v) for v in np.unique(other.values[np.isfinite(other.values)])[:3]})
        if len(values) == 2 and all(value.is_integer() for value in values):
            negative = int(values[0] if values[0] < 0 else values[1])
            told = f"{other.channel.name!r} is called its sign, and it is never negative"
            return guess.because(told, sign=(other.channel.name, negative))
    return guess


def headings(profiles: tuple[Profile, ...], taken: set[str]) -> list[str]:
    """Return the channels that are a heading or a course, whichever."""
    never = set(vocabulary()["never"]["course"])
    return [
        p.channel.name
        for p in profiles
        if p.is_number
        and p.channel.name not in taken
        and fits_any(vocabulary()["headings"]["words"], p.channel.name)
        and not never & set(parts_of(p.channel.name))
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
    guesses = [_guess(f"wheel_{c}", p, "wheel") for c, p in zip(CORNERS, found, strict=False)]
    return [g for g in guesses if g] if len(found) == 4 and all(guesses) else []


def told_unit(profile: Profile) -> tuple[str, str | None]:
    """Return the unit that a channel has, as the file says it, and as a mapping writes it."""
    name, in_brackets = split_unit(profile.channel.name)
    text = profile.channel.unit.strip() or in_brackets
    return text, unit_called(text) or unit_behind(name)


def _guess(signal: str, profile: Profile, words: str) -> Guess | None:
    """Return a guess with a unit that the signal can have, or None."""
    si_unit = "m/s" if signal in {"north", "east"} else catalogue()[signal].unit
    named = f"its name has {words!r}"
    text, told = told_unit(profile)
    largest = float(np.nanquantile(np.abs(profile.values), 0.999))
    for unit, radius_m in ((told, None), (told, RADIUS_M)):
        measures = si_unit if radius_m is None else "m/s"
        if unit is None or (radius_m is not None and not signal.startswith("wheel_")):
            continue
        try:
            factor = conversion_factor(unit, measures) / (radius_m or 1.0)
        except ValueError:
            continue
        guess = Guess(signal, profile, unit, (named, f"its unit is {unit}"), radius_m)
        return _within_range(guess, largest * factor)
    if told is not None:
        return None
    unit, radius_m = _unit_of_values(si_unit, signal, largest)
    unknown = f" that is known: {text!r}" if text else ""
    reason = f"{NO_UNIT}{unknown}; values up to {largest:.3g} look like {unit}"
    guess = Guess(signal, profile, unit, (named, reason), radius_m)
    factor = conversion_factor(unit, si_unit if radius_m is None else "m/s") / (radius_m or 1.0)
    return _within_range(guess, largest * factor)


def _within_range(guess: Guess, largest: float) -> Guess:
    """Return a guess, with a doubt if its values are beyond what the catalogue can hold."""
    if guess.signal not in catalogue().signals:
        return guess
    signal = catalogue()[guess.signal]
    most = float(max(-signal.min, signal.max))
    if largest <= most or signal.cyclic:
        return guess
    return guess.doubted(
        f"in {guess.unit} it would be up to {largest:.3g} {signal.unit}, and the catalogue has "
        f"{most:g}"
    )


def _unit_of_values(si_unit: str, signal: str, largest: float) -> tuple[str, float | None]:
    """Return the unit that values of a car on a road are likely to have."""
    if signal.startswith("wheel_"):
        if largest > 300:
            return "rpm", None
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
