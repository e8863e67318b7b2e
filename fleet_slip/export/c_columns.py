"""The sources and columns of a program as statements of C.

Every value is a word of 32 bits, `MISSING` where there is none; a column times a number of the car
is one of 64. Whether a step needs 64 bits follows from the ranges of the signals.
"""

from collections import Counter
from collections.abc import Mapping

from fleet_slip.catalogue.columns import WEIGHT
from fleet_slip.export.c_names import LARGEST_32, field_names, integer_type, literal
from fleet_slip.export.program import Factor, Gated, Numbered, Program, Source, Window

LARGEST_UNSIGNED = 2**32 - 1


class ColumnWriter:
    """Writes statements, and counts what they do.

    Attributes:
        done: how often each helper is called, and each operation of a feature is done; `//64` is a
            division that needs 64 bits.
    """

    def __init__(self, program: Program) -> None:
        """Take a program."""
        self.program = program
        self.done: Counter[str] = Counter()
        self._fields = field_names(program)
        self._sizes = {
            one.name: max(abs(one.min_count), abs(one.max_count)) for one in program.signals
        }

    def sources(self) -> list[str]:
        """Return a function for each source that is a feature."""
        return [
            line
            for place, one in enumerate(self.program.sources)
            if one.arithmetic is not None
            for line in self._feature(place, one)
        ]

    def signals(self) -> list[str]:
        """Return statements that take the signals of a sample; beyond their range they miss."""
        self.done["within"] += len(self.program.signals)
        return [
            f"const int32_t {one.name}_in = within(sample->{field}, {literal(one.min_count)}, "
            f"{literal(one.max_count)});"
            for one, field in zip(self.program.signals, self._fields["signals"], strict=True)
        ]

    def values(self) -> list[str]:
        """Return statements that compute all sources."""
        found = []
        for place, one in enumerate(self.program.sources):
            value = f"{one.name}_in"
            if one.arithmetic is not None:
                value = f"feature_{place}({', '.join(f'{n}_in' for n in one.arithmetic.inputs)})"
            found.append(f"const int32_t source_{place} = {value}; /* {one.name} */")
        return found

    def columns(self) -> list[str]:
        """Return statements that compute all columns, before the rings move on."""
        found: list[str] = []
        for place, column in enumerate(self.program.columns):
            match column:
                case Window():
                    found += self._window(place, column)
                case Factor():
                    found.append(self._factor(place, column))
                case Gated():
                    found.append(self._gated(place, column))
                case Numbered():
                    found.append(self._numbered(place, column))
        return found

    def _feature(self, place: int, one: Source) -> list[str]:
        arithmetic = one.arithmetic
        assert arithmetic is not None  # noqa: S101 - for mypy
        names = [f"{name}_in" for name in arithmetic.inputs]
        lines = [
            f"/* {one.name}: of one tick, within {one.limit} */",
            f"static int32_t feature_{place}({', '.join(f'int32_t {name}' for name in names)})",
            "{",
        ]
        lines += [f"    if ({name} == MISSING) {{ return MISSING; }}" for name in names]
        texts: list[str] = []
        bounds: list[int] = []
        for number, step in enumerate(arithmetic.steps):
            operands = [texts[i] for i in step.operands]
            sizes = [bounds[i] for i in step.operands]
            if step.name or not step.function:
                texts.append(f"{step.name}_in" if step.name else literal(step.value))
                bounds.append(self._sizes[step.name] if step.name else abs(step.value))
            elif step.function == "*" and all(text.isdigit() for text in operands):
                bounds.append(sizes[0] * sizes[-1])
                texts.append(literal(bounds[-1]))
            else:
                value, bound = operation(step.function, operands, sizes)
                wide = step.function == "//" and max(sizes) > LARGEST_32
                self.done["//64" if wide else step.function] += 1
                bounds.append(bound)
                if step.function == "//" and not operands[1].isdigit():
                    lines.append(f"    if ({operands[1]} <= 0) {{ return MISSING; }}")
                lines.append(f"    const {integer_type(bound)} s{number} = {value};")
                texts.append(f"s{number}")
            if number == arithmetic.guard:
                least = literal(arithmetic.at_least)
                lines.append(f"    if ({texts[-1]} < {least}) {{ return MISSING; }}")
        self.done["clip"] += 1
        return [*lines, f"    return clip({texts[-1]}, {one.limit});", "}", ""]

    def _window(self, place: int, one: Window) -> list[str]:
        now, sums = f"source_{one.source}", f"state->sum_{sum_key(place, one)}"
        counts = sums.replace("sum_", "values_")
        lines = []
        if one.over == "lag":
            lines.append(f"const int32_t past_{place} = {self.ago(one.source, one.ticks)};")
            now = f"past_{place}"
        elif one.over == "running_mean":
            self.done["gather"] += 1
            lines.append(f"gather(&{sums}, &{counts}, {one.most_values}, {now});")
        total, count, largest = now, "1", one.source_limit
        if one.over in ("mean", "sum", "running_mean"):
            total, largest = sums, one.source_limit * one.most_values
            count = "1" if one.over == "sum" else f"{counts}"
        most = one.most_values if count != "1" else 1
        quotient = self.nearest(
            total, one.numerator, one.denominator, count, most, one.limit, largest
        )
        value = now if quotient == now else f"({now} == MISSING) ? MISSING : {quotient}"
        return [*lines, f"const int32_t column_{place} = {value};"]

    def nearest(
        self,
        total: str,
        numerator: int,
        denominator: int,
        count: str,
        most: int,
        limit: int,
        largest: int,
    ) -> str:
        """Return the call that rounds a quotient, in 32 bits where all of it fits."""
        if numerator == denominator == 1 and count == "1" and largest <= limit:
            return total
        size = 2 * largest * numerator + denominator * most
        if size <= LARGEST_UNSIGNED:
            self.done["nearest_32"] += 1
            times = f"{denominator}U" if count == "1" else f"{denominator}U * {count}"
            return f"nearest_32({total}, {numerator}U, {times}, {limit})"
        self.done["nearest_64"] += 1
        times = str(denominator) if count == "1" else f"(int64_t){denominator} * (int64_t){count}"
        return f"nearest_64({total}, {numerator}, {times}, {limit})"

    def ago(self, source: int, ticks: int) -> str:
        """Return the call that reads a source so many ticks ago."""
        one = self.program.sources[source]
        width = ring_width(one)
        self.done[f"ago_{width}"] += 1
        return f"ago_{width}(state->ring_{source}, state->at_{source}, {one.ticks}U, {ticks}U)"

    def _factor(self, place: int, one: Factor) -> str:
        fact = f"state->{self._fields['facts'][one.fact]}"
        of = f"column_{one.of}"
        total = f"(int64_t){of} * {_less(fact, one.less)}"
        self.done.update(["*", "-", "nearest_64"])
        call = f"nearest_64({total}, {one.numerator}, {one.denominator}, {one.limit})"
        missing = f"(({of} == MISSING) || ({fact} == MISSING))"
        return f"const int32_t column_{place} = {missing} ? MISSING : {call};"

    def _gated(self, place: int, one: Gated) -> str:
        of, by = f"column_{one.of}", f"column_{one.by}"
        high = "MISSING" if one.high is None else literal(one.high)
        weight = f"weight({by}, {literal(one.low)}, {literal(one.peak)}, {high})"
        self.done.update(["weight", "nearest_32"])
        call = f"nearest_32({of} * {weight}, 1U, {WEIGHT}U, {one.largest})"
        return (
            f"const int32_t column_{place} = (({of} == MISSING) || ({by} == MISSING)) "
            f"? MISSING : {call};"
        )

    def _numbered(self, place: int, one: Numbered) -> str:
        number = f"state->{self._fields['numbers'][one.number]}"
        stand_in = "0" if one.running is None else f"column_{one.running}"
        factor = f"(({number} == MISSING) ? {stand_in} : {_less(number, one.less)})"
        of = f"column_{one.of}"
        self.done.update(["-"] if one.alone else ["*", "-"])
        missing = f"({of} == {missing_of(self.program, one.of)})"
        if one.running is not None:
            missing = f"({missing} || (({number} == MISSING) && ({stand_in} == MISSING)))"
        value = f"(int64_t){factor}" if one.alone else f"(int64_t){of} * {factor}"
        return f"const int64_t column_{place} = {missing} ? MISSING_64 : {value};"


def _less(value: str, less: int) -> str:
    return f"({value} - {literal(less)})" if less else value


def missing_of(program: Program, place: int) -> str:
    """Return what a column is where it is missing."""
    return "MISSING_64" if isinstance(program.columns[place], Numbered) else "MISSING"


def sum_key(place: int, one: Window) -> str:
    """Return what a running sum is called: windows of one length share theirs."""
    return f"{place}" if one.over == "running_mean" else f"{one.source}_over_{one.ticks}"


def summed(program: Program) -> Mapping[str, tuple[int, Window]]:
    """Return the windows that need a sum, by its key, each with the place of its first column."""
    found: dict[str, tuple[int, Window]] = {}
    for place, one in enumerate(program.columns):
        if isinstance(one, Window) and one.over in ("mean", "sum", "running_mean"):
            found.setdefault(sum_key(place, one), (place, one))
    return found


def sum_type(one: Window) -> str:
    """Return the type of a window's sum."""
    if one.over == "running_mean":
        return "int64_t"
    return integer_type(one.source_limit * one.ticks)


def ring_width(source: Source) -> int:
    """Return the bits of a word of a source's ring: its limit, and one value for missing."""
    return 16 if source.limit < 2**15 else 32


def operation(function: str, operands: list[str], sizes: list[int]) -> tuple[str, int]:
    """Return an operation of a step in C, and the largest size that it can have."""
    a, b = operands[0], operands[-1]
    bound = {"+": sum(sizes), "-": sum(sizes), "*": sizes[0] * sizes[-1], "sign": 1}.get(
        function, sizes[0]
    )
    match function:
        case "negative":
            return f"-({a})", bound
        case "abs":
            return f"({a} < 0) ? -{a} : {a}", bound
        case "sign":
            return f"sign({a})", bound
        case "//":
            # C truncates as SQL does; the type of the result must hold the dividend.
            both = max(sizes) > LARGEST_32 >= bound
            return (f"(int32_t)({a} / {b})" if both else f"{a} / {b}"), bound
    wide = bound > LARGEST_32 >= max(sizes)
    return f"{'(int64_t)' if wide else ''}{a} {function} {b}", bound
