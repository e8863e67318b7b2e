"""Columns lowered for the warehouse, which counts how often a value is clipped.

Clipping comes last, lest what is missing be counted; exported programs clip first: the same.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from fleet_slip.catalogue.definitions import Definition, features_behind, plain_column
from fleet_slip.columns.lowering import Lowering
from fleet_slip.columns.operations import Range, Step, operands_of
from fleet_slip.errors import DataError

LOGGED: Range = (-(2**15), 2**15 - 1)
"""What 16 bits of a log can hold."""


class _ClippedLast(Lowering):
    def clip_where(self, step: int, limit: int, there: Callable[[], int]) -> int:
        return self.clip(self.do("where", step, there()), limit)


@dataclass(frozen=True)
class CountedColumns:
    """Steps, and how often what they clip counts.

    Attributes:
        steps: those of `lowered` by their numbers, with the range of each in `ranges`.
        places: the step of each column of one row, and of each column over time, by name.
        times: how often a step's clipping counts: once for each feature or column over time that
            it is in; for gates and what they gate, once in all.
    """

    lowered: Lowering
    steps: tuple[Step, ...]
    ranges: list[Range]
    places: Mapping[str, int]
    times: Mapping[int, int]

    @classmethod
    def of(
        cls, rows: Mapping[str, Definition], over_time: Mapping[str, Definition]
    ) -> "CountedColumns":
        """Lower columns over time, and the `rows` that they look back on with others."""
        signals = dict.fromkeys(name for one in rows.values() for name in one.signals)
        lowered = _ClippedLast({name: place for place, name in enumerate(signals)})
        parts = [part for one in over_time.values() if not one.gate for part in parts_of(one)]
        gated = [part for one in over_time.values() if one.gate for part in parts_of(one)]
        parts += dict.fromkeys(gated)
        places = {}
        for name, row in rows.items():  # a row, and all that looks back on it, stand together
            places[name] = lowered.row(row)
            for part in parts:
                if part.of == name:
                    lowered.column(part)
        found = {name: lowered.column(one) for name, one in over_time.items()}
        steps = tuple(lowered.steps)
        ends = {*places.values()}
        times = Counter(places[name] for name, row in rows.items() if row.sql)
        for part in parts:
            times.update(_clips(steps, lowered.column(part), ends))
        ranges = lowered.ranges([LOGGED] * len(signals))
        return cls(lowered, steps, ranges, places | found, times)


def parts_of(one: Definition) -> Iterator[Definition]:
    """Yield what a column is made of, each without a gate or a number."""
    if one.number is not None:
        yield from parts_of(one.model_copy(update={"number": None}))
        if one.number.running is not None:
            yield one.number.running
    else:
        yield from one.parts


def rows_of(
    rows: Mapping[str, Definition], over_time: Mapping[str, Definition]
) -> dict[str, Definition]:
    """Return columns of one row, looked back on ones too. Raises `QuestionError`, `DataError`."""
    found = dict(rows)
    features_behind(over_time)
    for one in (part for window in over_time.values() for part in parts_of(window)):
        row = plain_column(one.of, one.sql, one.of_bits)
        if found.setdefault(one.of, row) != row:
            raise DataError(f"the feature {one.of} is defined in two ways.")
    return found


def _clips(steps: tuple[Step, ...], of: int, ends: Iterable[int]) -> set[int]:
    """Return the steps that clip on the way to a step from `ends`, which are not looked into."""
    found, waiting = set[int](), [of]
    while waiting:
        step = waiting.pop()
        if step not in ends:
            found |= {step} if steps[step][0] == "clip" else set()
            waiting += operands_of(steps[step])
    return found
