"""A published version tick by tick, for test benches: `Fleet.estimator`."""

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

from fleet_slip.catalog.arithmetic import COMPUTED, nearest
from fleet_slip.catalog.calibration_parameters import round_number
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.columns.lowering import operation_of, plain_of, power
from fleet_slip.errors import InputError
from fleet_slip.export.compile import compile_program
from fleet_slip.export.program import Car, Program
from fleet_slip.models.manifest import Manifest

_COMPUTED: Mapping[str, Callable[..., int | None]] = {
    **COMPUTED,
    "nearest": lambda a, b: nearest(a, b) if b > 0 else None,
    "min": min,
    "max": max,
    "power": power,
    "clip": lambda a, most: max(-most, min(a, most)),
    "at_least": lambda a, least: a if a >= least else None,
    "where": lambda a, _: a,
}
"""What an operation is, of values of the same tick none of which is missing."""

KEPT_PARTS = 256
"""Parts of what a car has learned that it can keep for its next drive."""


class Estimator:
    """Estimates the side-slip angle of a drive, a sample at a time.

    Attributes:
        columns: names in SI units that a sample has.
    """

    def __init__(
        self, catalog: Catalog, manifest: Manifest, car: Mapping[str, Any] | None = None
    ) -> None:
        """Take a version, and what is known of the car: facts, and numbers in SI units, by name.

        Raises `InputError` for what the version does not use, and what `compile_program` raises.
        """
        self._program = program = compile_program(catalog, manifest)
        known = _known(manifest, program, car or {})
        self.columns = tuple(one.column for one in program.signals)
        self._manifest = manifest
        steps = [(operation_of(step), plain_of(step)) for step in program.steps]
        car_counts = {
            "fact": known.fact_counts(program),
            "number": known.number_counts(program),
        }
        self._begin: list[int | None] = [None] * len(steps)
        self._steps = []
        for place, (name, plain) in enumerate(steps):
            if name == "constant":
                self._begin[place] = plain[0]
            elif name in car_counts:
                self._begin[place] = car_counts[name][plain[0]]
            else:
                self._steps.append((place, name, _COMPUTED.get(name), plain))
        scale_of = {one.name: float(one.scale) for one in program.signals}
        self._terms = [
            (place, scale_of[t.signal] if t.logged else float(t.scale), t.coefficient)
            for t, place in zip(manifest.terms, program.angle.places, strict=True)
        ]
        self._windows: dict[tuple[int, ...], list[int]] = {}
        self.restart()

    def step(self, sample: Mapping[str, float | None]) -> float | None:
        """Return the angle of the next tick in rad; None if there is none.

        A sample has the columns of `columns` in SI units, None where a value is missing, as one
        that is beyond its valid range is; others are left alone. They are rounded to counts, half
        to even, as the sensors do. The angles of a drive have the bits that `predict` computes.

        Raises `InputError` if the sample lacks a column.
        """
        counts, now = self._counts(sample), self._begin.copy()
        for place, name, compute, plain in self._steps:
            if compute is not None:
                values = [now[one] for one in plain]
                now[place] = None if None in values else compute(*values)
            elif name == "signal":
                now[place] = counts[plain[0]]
            elif name == "else":
                now[place] = now[plain[1]] if now[plain[0]] is None else now[plain[0]]
            elif name == "ago":
                now[place] = self._ago(*plain)
            elif name == "sum":
                now[place] = self._slide(now[plain[0]], *plain)
            else:
                now[place] = self._windows[plain][1]
        for of, ring in self._rings.items():
            ring[self._tick % len(ring)] = now[of]
        self._tick += 1
        estimate = self._manifest.intercept
        for place, scale, coefficient in self._terms:
            count = now[place]
            if count is None:
                return None
            estimate += coefficient * (count * scale)
        return estimate

    def skip(self, ticks: int = 1) -> None:
        """Take ticks that were not logged."""
        nothing = dict.fromkeys(self.columns)
        for _ in range(min(ticks, self._program.longest_ticks + 1)):  # then nothing is left
            self.step(nothing)

    def restart(self, kept: int = 0) -> None:
        """Begin another drive of the same car, which remembers `kept` of 256 parts of its slopes.

        As the C export's `next` does. Raises `InputError` for more parts.
        """
        if not 0 <= kept <= KEPT_PARTS:
            raise InputError(f"kept = {kept}: choose 0 to {KEPT_PARTS} parts.")
        before = self._windows
        self._tick = 0
        rings = self._program.rings.items()
        self._rings: dict[int, list[int | None]] = {of: [None] * n for of, n in rings if n}
        self._windows = {window: [0, 0] for window in self._program.sums}
        for window in self._program.learned if before else ():
            self._windows[window] = [part * kept // KEPT_PARTS for part in before[window]]

    def _counts(self, sample: Mapping[str, float | None]) -> list[int | None]:
        """Return the counts of a sample, None where missing or out of range."""
        found: list[int | None] = []
        name = self._manifest.name
        for one in self._program.signals:
            try:
                value = sample[one.column]
                ratio = float("nan") if value is None else float(value) / float(one.scale)
            except KeyError:
                missing = ", ".join(column for column in self.columns if column not in sample)
                raise InputError(f"{name} needs {missing} in every sample.") from None
            except (TypeError, ValueError):
                raise InputError(f"{name}: a sample is not a number.") from None
            count = round(ratio) if abs(ratio) < 2**31 else None
            inside = count is not None and one.min_count <= count <= one.max_count
            found.append(count if inside else None)
        return found

    def _ago(self, of: int, ticks: int) -> int | None:
        ring = self._rings[of]
        return ring[(self._tick - ticks) % len(ring)]

    def _slide(self, newest: int | None, of: int, ticks: int, most: int) -> int:
        """Bring a window's sum and number of values to this tick; return the sum."""
        window = self._windows[of, ticks, most]
        oldest = self._ago(of, ticks) if ticks else None
        if oldest is not None:
            window[0] -= oldest
            window[1] -= 1
        if newest is not None and window[1] < most:
            window[0] += newest
            window[1] += 1
        return window[0]


def _known(manifest: Manifest, program: Program, given: Mapping[str, Any]) -> Car:
    """Return a car: numbers in counts."""
    numbers = {one.name: one for one in program.numbers}
    used = {*numbers, *(one.name for one in program.facts)}
    if unknown := sorted({*given} - used):
        raise InputError(
            f"{manifest.name} does not use {', '.join(unknown)} of a car. It uses: "
            f"{', '.join(sorted(used)) or 'nothing'}."
        )
    counts = {
        name: count
        for name, one in numbers.items()
        if given.get(name) is not None
        and (count := round_number(_fraction(given[name]), _fraction(str(one.grain)))) is not None
    }
    return Car({name: value for name, value in given.items() if name not in numbers}, counts)


def _fraction(value: Any) -> Fraction:
    try:
        return Fraction(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{value!r} is not a number.") from None
