"""Steps as SQL in layers: each has columns made of those of the layers before."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence

from fleet_slip.columns.operations import (
    GIVEN,
    OPERATIONS,
    Range,
    Step,
    operands_of,
    operation_of,
    plain_of,
)
from fleet_slip.columns.sql_operations import sql_constant, sql_of

INLINE = ("+", "-", "*", "negative")
"""What may stand within another step, where it is used once."""


class SqlLayers:
    """The layers of steps; those that are asked for are written, with what they need.

    Attributes:
        layers: the columns of each, by its number from 1.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        ranges: Sequence[Range],
        table: Mapping[str, str],
        given: Callable[[str, int], str],
    ) -> None:
        """Take steps with their ranges, what operations are in SQL, and what is given is there."""
        self._steps, self._ranges, self._table, self._given = steps, ranges, table, given
        self.layers: defaultdict[int, list[str]] = defaultdict(list)
        self._uses = Counter(of for step in steps for of in operands_of(step))
        self._texts: dict[int, tuple[str, int]] = {}

    def text(self, number: int) -> tuple[str, int]:
        """Return a step in SQL, and the layer that has all columns in it."""
        if number not in self._texts:
            self._texts[number] = self._written(number)
        return self._texts[number]

    def column(self, number: int) -> tuple[str, int]:
        """Return a step as one word."""
        text, layer = self.text(number)
        if " " in text:
            self._texts[number] = self._named(number, text, layer)
        return self._texts[number]

    def _written(self, number: int) -> tuple[str, int]:
        step = self._steps[number]
        name, plain = operation_of(step), plain_of(step)
        if name == "constant":
            return sql_constant(plain[0]), 0
        if name in GIVEN:
            return self._given(name, plain[0]), 0
        one = OPERATIONS[name]
        own = plain[: one.steps]
        inline = name in INLINE
        parts = [self.text(i) if inline else self.column(i) for i in own]
        text = sql_of(
            name,
            [part for part, _ in parts],
            *plain[one.steps :],
            divides_by=self._ranges[own[-1]][0],
            table=self._table,
        )
        layer = max(layer for _, layer in parts)
        if inline and self._uses[number] == 1:
            return text, layer
        return self._named(number, text, layer)

    def _named(self, number: int, text: str, layer: int) -> tuple[str, int]:
        self.layers[layer + 1].append(f"{text} AS step_{number}")
        return f"step_{number}", layer + 1
