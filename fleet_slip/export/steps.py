"""A program as one list of steps on whole numbers, as the JSON document has it: docs/export.md.

A step is an operation and what it works on: numbers of earlier steps, or, of `signal`, `fact`,
`number`, `constant` and the operations that look back, plain numbers. Equal steps stand once.
"""

from fleet_slip.catalogue.columns import WEIGHT
from fleet_slip.export.program import Column, Factor, Gated, Numbered, Program, Source, Window

Step = tuple[str | int, ...]


def steps_of(program: Program) -> tuple[list[Step], list[int]]:
    """Return the steps of a program, and which of them is the column of each term."""
    writer = _Writer(program)
    for source in program.sources:
        writer.sources.append(writer.source(source))
    for column in program.columns:
        writer.columns.append(writer.column(column))
    return [*writer.known], [writer.columns[place] for place, _ in program.angle.terms]


class _Writer:
    """Numbers steps, and knows which of them each source and column is."""

    def __init__(self, program: Program) -> None:
        """Begin with no step."""
        self.known: dict[Step, int] = {}
        self.sources: list[int] = []
        self.columns: list[int] = []
        self._signals = {one.name: place for place, one in enumerate(program.signals)}

    def do(self, operation: str, *operands: int) -> int:
        """Add a step; return its number."""
        return self.known.setdefault((operation, *operands), len(self.known))

    def constant(self, value: int) -> int:
        """Return the number of a step that is always the same."""
        return self.do("constant", value)

    def clip(self, step: int, limit: int) -> int:
        """Return a step within ±limit."""
        return self.do("clip", step, self.constant(limit))

    def nearest(self, step: int, numerator: int, divisor: int) -> int:
        """Return a step times a constant over another step, rounded."""
        times = step if numerator == 1 else self.do("*", step, self.constant(numerator))
        return self.do("nearest", times, divisor)

    def less(self, step: int, constant: int) -> int:
        """Return a step less a constant."""
        return self.do("-", step, self.constant(constant)) if constant else step

    def source(self, one: Source) -> int:
        """Return the step of a source."""
        if one.arithmetic is None:
            return self.do("signal", self._signals[one.name])
        found: list[int] = []
        for step in one.arithmetic.steps:
            if step.name:
                found.append(self.do("signal", self._signals[step.name]))
            elif not step.function:
                found.append(self.constant(step.value))
            else:
                found.append(self.do(step.function, *(found[i] for i in step.operands)))
        result = self.clip(found[-1], one.limit)
        if one.arithmetic.guard is None:
            return result
        least = self.constant(one.arithmetic.at_least)
        return self.do("where", result, self.do("at_least", found[one.arithmetic.guard], least))

    def column(self, column: Column) -> int:
        """Return the step of a column."""
        match column:
            case Window():
                return self._window(column)
            case Factor():
                fact = self.less(self.do("fact", column.fact), column.less)
                times = self.do("*", self.columns[column.of], fact)
                divisor = self.constant(column.denominator)
                return self.clip(self.nearest(times, column.numerator, divisor), column.limit)
            case Gated():
                weight = self._weight(self.columns[column.by], column)
                return self.nearest(
                    self.do("*", self.columns[column.of], weight), 1, self.constant(WEIGHT)
                )
            case Numbered():
                stand_in = (
                    self.constant(0) if column.running is None else self.columns[column.running]
                )
                number = self.less(self.do("number", column.number), column.less)
                factor = self.do("else", number, stand_in)
                of = self.columns[column.of]
                return self.do("where", factor, of) if column.alone else self.do("*", of, factor)

    def _window(self, one: Window) -> int:
        now = total = self.sources[one.source]
        divisor = self.constant(one.denominator)
        if one.over == "lag":
            now = total = self.do("ago", now, one.ticks)
        elif one.over is not None:
            window = (self.sources[one.source], one.ticks, one.most_values)
            total = self.do("sum", *window)
            if one.over != "sum":
                divisor = self.do("*", divisor, self.do("values", *window))
        found = self.clip(self.nearest(total, one.numerator, divisor), one.limit)
        return found if total == now else self.do("where", found, now)

    def _weight(self, by: int, gate: Gated) -> int:
        """Return the weight of a gate: what rises, or what falls where that is less."""
        full, none = self.constant(WEIGHT), self.constant(0)
        rises = self._ramp(by, gate.low, gate.peak)
        opened = self.do("max", self.do("min", rises, full), none)
        if gate.high is None:
            return opened
        falls = self.do("-", full, self._ramp(by, gate.peak, gate.high))
        return self.do("max", self.do("min", opened, falls), none)

    def _ramp(self, by: int, low: int, high: int) -> int:
        times = self.do("*", self.less(by, low), self.constant(WEIGHT))
        return self.do("//", times, self.constant(high - low))
