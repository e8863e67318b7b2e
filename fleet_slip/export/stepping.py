"""Estimates of a published version tick by tick, for test benches: `Fleet.estimator`."""

from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import partial
from typing import Any

from fleet_slip.catalog.arithmetic import COMPUTED, nearest
from fleet_slip.catalog.calibration_parameters import round_number
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.columns.lowering import power
from fleet_slip.errors import InputError
from fleet_slip.export.compile import compile_program
from fleet_slip.export.program import Car, Program
from fleet_slip.models.manifest import Manifest

_OPERATIONS: Mapping[str, Callable[..., int | None]] = {
    **COMPUTED,
    "nearest": lambda a, b: nearest(a, b) if b > 0 else None,
    "min": min,
    "max": max,
    "power": power,
    "clip": lambda a, limit: max(-limit, min(a, limit)),
    "at_least": lambda a, bound: a if a >= bound else None,
    "where": lambda a, _: a,
}
"""Operations on values of one tick, none of which is missing."""


def _shifted(value: int, bits: int) -> int:
    """Return a value over 2^bits, to the nearest."""
    return nearest(value, 1 << bits)


RETAINED_PARTS = 256
"""Parts of the sums of a drive that can be retained for the next drive."""


class Estimator:
    """Estimates the side-slip angle of a drive, sample by sample.

    Parameters
    ----------
    catalog
        Signals and features.
    manifest
        Manifest of the version.
    car
        Properties of the car: facts, and numbers in SI units, by name.

    Attributes
    ----------
    columns
        Columns in SI units that a sample must have.

    Raises
    ------
    InputError
        If the version does not use a property of the car.
    """

    def __init__(
        self, catalog: Catalog, manifest: Manifest, car: Mapping[str, Any] | None = None
    ) -> None:
        manifest = manifest.estimate
        self._program = program = compile_program(catalog, manifest)
        properties = _parse_car(manifest, program, car or {})
        self.columns = tuple(signal.column for signal in program.signals)
        self._manifest = manifest
        steps = [program.operation(step) for step in range(len(program.steps))]
        car_counts = {
            "fact": properties.fact_counts(program),
            "number": properties.number_counts(program),
        }
        self._initial: list[int | None] = [None] * len(steps)
        self._steps: list[tuple[int, str, Callable[..., int | None] | None, tuple[int, ...]]] = []
        for place, (name, plain) in enumerate(steps):
            if name == "constant":
                self._initial[place] = plain[0]
            elif name == "shift":
                self._steps.append((place, name, partial(_shifted, bits=plain[1]), plain[:1]))
            elif name in car_counts:
                self._initial[place] = car_counts[name][plain[0]]
            else:
                self._steps.append((place, name, _OPERATIONS.get(name), plain))
        scale_of = {signal.name: float(signal.scale) for signal in program.signals}
        self._terms = [
            (place, scale_of[t.signal] if t.logged else float(t.scale), t.coefficient)
            for t, place in zip(manifest.terms, program.angle.places, strict=True)
        ]
        self._windows: dict[tuple[int, ...], list[int]] = {}
        self.restart()

    def step(self, sample: Mapping[str, float | None]) -> float | None:
        """Estimate the angle at the next tick.

        The angles of a drive have the same bits as those of `predict`.

        Parameters
        ----------
        sample
            Values of `columns` in SI units. None, or a value outside the valid range, is missing.
            Other keys are ignored. Values are rounded to counts, halves to even.

        Returns
        -------
        float or None
            Angle in rad; None if a column of the model is missing.

        Raises
        ------
        InputError
            If the sample lacks a column.
        """
        counts, now = self._counts(sample), self._initial.copy()
        following: dict[int, int] = {}
        for place, name, compute, plain in self._steps:
            if compute is not None:
                values = [now[operand] for operand in plain]
                now[place] = None if None in values else compute(*values)
            elif name == "signal":
                now[place] = counts[plain[0]]
            elif name == "else":
                now[place] = now[plain[1]] if now[plain[0]] is None else now[plain[0]]
            elif name == "ago":
                now[place] = self._ago(*plain)
            elif name == "state":
                now[place] = self._states[place]
            elif name == "next":
                following[plain[1]] = now[plain[0]] or 0
            elif name == "sum":
                now[place] = self._slide(now[plain[0]], *plain)
            else:
                now[place] = self._windows[plain][1]
        for source, ring in self._rings.items():
            ring[self._tick % len(ring)] = now[source]
        self._states |= following
        self._tick += 1
        estimate = self._manifest.intercept
        for place, scale, coefficient in self._terms:
            count = now[place]
            if count is None:
                return None
            estimate += coefficient * (count * scale)
        return estimate

    @property
    def states(self) -> tuple[int, ...]:
        """States of the filter after the last tick, in the order of the program's steps."""
        return tuple(self._states.values())

    def skip(self, ticks: int = 1) -> None:
        """Advance by ticks without a message."""
        empty = dict.fromkeys(self.columns)
        for _ in range(min(ticks, self._program.longest_ticks + 1)):  # then the history is empty
            self.step(empty)

    def restart(self, retained: int = 0) -> None:
        """Start another drive of the same car.

        Parameters
        ----------
        retained
            Parts of 256 of the sums that slopes are computed from, as in `next` of the C export.

        Raises
        ------
        InputError
            If `retained` is not from 0 to 256.
        """
        if not 0 <= retained <= RETAINED_PARTS:
            raise InputError(f"retained = {retained}: choose 0 to {RETAINED_PARTS} parts.")
        previous = self._windows
        self._tick = 0
        self._states = dict.fromkeys(self._program.states, 0)
        rings = self._program.rings.items()
        self._rings: dict[int, list[int | None]] = {place: [None] * n for place, n in rings if n}
        self._windows = {window: [0, 0] for window in self._program.sums}
        for window in self._program.learned if previous else ():
            values = [value * retained // RETAINED_PARTS for value in previous[window]]
            self._windows[window] = values

    def _counts(self, sample: Mapping[str, float | None]) -> list[int | None]:
        """Convert a sample to counts; None: missing or out of range."""
        counts: list[int | None] = []
        name = self._manifest.name
        for signal in self._program.signals:
            try:
                value = sample[signal.column]
                ratio = float("nan") if value is None else float(value) / float(signal.scale)
            except KeyError:
                missing = ", ".join(column for column in self.columns if column not in sample)
                raise InputError(f"{name} needs {missing} in every sample.") from None
            except (TypeError, ValueError):
                raise InputError(
                    f"{name}: {signal.column} of a sample is not a number. Give a number or None."
                ) from None
            count = round(ratio) if abs(ratio) < 2**31 else None
            inside = count is not None and signal.min_count <= count <= signal.max_count
            counts.append(count if inside else None)
        return counts

    def _ago(self, source: int, ticks: int) -> int | None:
        ring = self._rings[source]
        return ring[(self._tick - ticks) % len(ring)]

    def _slide(self, newest: int | None, source: int, ticks: int, limit: int) -> int:
        """Update a window's sum and number of values to this tick; return the sum."""
        window = self._windows[source, ticks, limit]
        oldest = self._ago(source, ticks) if ticks else None
        if oldest is not None:
            window[0] -= oldest
            window[1] -= 1
        if newest is not None and window[1] < limit:
            window[0] += newest
            window[1] += 1
        return window[0]


def _parse_car(manifest: Manifest, program: Program, values: Mapping[str, Any]) -> Car:
    """Return a car with numbers in counts."""
    numbers = {number.name: number for number in program.numbers}
    names = {*numbers, *(fact.name for fact in program.facts)}
    if unused := sorted({*values} - names):
        raise InputError(
            f"{manifest.name} does not use {', '.join(unused)} of a car. It uses: "
            f"{', '.join(sorted(names)) or 'no properties'}."
        )
    counts = {
        name: count
        for name, number in numbers.items()
        if values.get(name) is not None
        and (count := round_number(_fraction(values[name]), _fraction(str(number.grain))))
        is not None
    }
    return Car({name: value for name, value in values.items() if name not in numbers}, counts)


def _fraction(value: Any) -> Fraction:
    try:
        return Fraction(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{value!r} is not a number. Give a number.") from None
