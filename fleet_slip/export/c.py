"""A program in C99, in integers alone, without allocation or recursion, and what goes with it.

The C stands in `templates/`.
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from fleet_slip.columns.lowering import operation_of, plain_of, size_of
from fleet_slip.export.program import Program, Steps
from fleet_slip.export.templating import (
    INDENT,
    LARGEST_32,
    c_prefix,
    different,
    field_names,
    fill_in_version,
    integer_type,
    literal,
    read_source,
)
from fleet_slip.models.registry import ModelVersion

# The steps of a program as statements of C.
#
# A step is a constant of 32 or 64 bits, whichever its range needs, and 0 where it is missing.
# Whether it is there is told by a bool of each step that can be missing by itself. What is kept
# from tick to tick has the value `MISSING` instead.

LARGEST_UNSIGNED = 2**32 - 1


class StepWriter:
    """Writes the statements of what is asked for, each once, and counts what they do.

    Attributes:
        lines: the statements.
        done: how often each helper is called and each operation is done; `//64` is a division
            that needs 64 bits.
    """

    def __init__(self, program: Steps) -> None:
        """Take a program."""
        self.program = program
        self.lines: list[str] = []
        self.done: Counter[str] = Counter()
        self._roots = program.roots
        self._values: dict[int, str] = {}
        self._there: dict[int, str] = {}
        self._words: dict[int, str] = {}
        self._slid: set[str] = set()
        fields = field_names(program)
        within = zip(program.signals, fields["signals"], strict=True)
        self._given = {
            "signal": [
                f"within(sample->{field}, {literal(one.min_count)}, {literal(one.max_count)})"
                for one, field in within
            ],
            "fact": [f"state->{field}" for field in fields["facts"]],
            "number": [f"state->{field}" for field in fields["numbers"]],
        }

    def value(self, step: int) -> str:
        """Return what a step is in C, after what computes it."""
        if step not in self._values:
            name, plain = operation_of(self.program.steps[step]), plain_of(self.program.steps[step])
            self._values[step] = _COMPUTED.get(name, StepWriter._arithmetic)(self, step, *plain)
        return self._values[step]

    def there(self, *steps: int) -> str:
        """Return the condition that all of some steps are there."""
        roots = dict.fromkeys(root for step in steps for root in self._roots[step])
        return " && ".join(self._present(root) for root in roots) or "true"

    def kept(self, step: int) -> str:
        """Return a step as it is kept: `MISSING` where it is."""
        if operation_of(self.program.steps[step]) in _TAKEN:
            return self._word(step)
        value = self.value(step)
        return f"(({self.there(step)}) ? {value} : MISSING)"

    def size(self, step: int) -> int:
        """Return the largest size of a step."""
        return size_of(self.program.ranges[step])

    def _present(self, root: int) -> str:
        """Return the bool that tells whether a step is there by itself."""
        if root not in self._there:
            name = operation_of(self.program.steps[root])
            taken = name in _TAKEN
            present = f"({self._word(root)} != MISSING)" if taken else _PRESENT[name](self, root)
            self._there[root] = self._declare("bool", "has", root, present)
        return self._there[root]

    def _arithmetic(self, step: int, *of: int) -> str:
        name, values = operation_of(self.program.steps[step]), [self.value(one) for one in of]
        if name == "*" and "1" in values:
            return values[values[0] == "1"]
        if name == "max" and self.size(step) > LARGEST_32:
            name = "max_64"
        self.done[name] += 1
        if name in "+-*" and self.size(step) > LARGEST_32 >= max(map(self.size, of)):
            values[0] = f"(int64_t){values[0]}"
        return self._set(step, _WRITTEN[name].format(*values))

    def _clipped(self, step: int, of: int, limit: int) -> str:
        value, most = self.value(of), self.size(limit)
        if self.size(of) <= most:
            return value
        self.done["clip"] += 1
        return self._set(step, f"clip({value}, {most})")

    def _chosen(self, step: int, one: int, other: int) -> str:
        first, second = self.value(one), self.value(other)
        return self._set(step, f"({self.there(one)}) ? {first} : {second}")

    def _truncated(self, step: int, a: int, b: int) -> str:
        wide = max(self.size(a), self.size(b)) > LARGEST_32
        quotient = f"{self.value(a)} / {self._divisor(step, b)}"
        self.done["//64" if wide else "//"] += 1
        return self._set(step, f"(int32_t)({quotient})" if self._narrows(step, wide) else quotient)

    def _nearest(self, step: int, a: int, b: int) -> str:
        value = self.value(a)
        if self.program.ranges[b] == (1, 1):
            return value
        divisor, wide = self._divisor(step, b), 2 * self.size(a) + self.size(b) > LARGEST_UNSIGNED
        self.done["nearest_64" if wide else "nearest_32"] += 1
        if not wide:
            divisor = f"{divisor}U" if divisor.isdigit() else f"(uint32_t){divisor}"
        call = f"nearest_{64 if wide else 32}({value}, {divisor})"
        return self._set(step, f"(int32_t){call}" if self._narrows(step, wide) else call)

    def _divisor(self, step: int, of: int) -> str:
        """Return what may be divided by: 1 where the quotient is missing."""
        divisor = self.value(of)
        if self.program.ranges[of][0] > 0:
            return divisor
        return f"({self._present(step)} ? {divisor} : 1)"

    def _given_or_past(self, step: int, *_: int) -> str:
        return self._set(step, f"{self._present(step)} ? {self._word(step)} : 0")

    def _narrows(self, step: int, wide: bool) -> bool:
        return wide and self.size(step) <= LARGEST_32

    def _word(self, step: int) -> str:
        """Return what is given, or was, as a word that may be `MISSING`."""
        if step not in self._words:
            name, plain = operation_of(self.program.steps[step]), plain_of(self.program.steps[step])
            self.done["within"] += name == "signal"
            taken = self._ago(*plain) if name == "ago" else self._given[name][plain[0]]
            self._words[step] = self._declare("int32_t", "in", step, taken)
        return self._words[step]

    def _ago(self, of: int, ticks: int) -> str:
        """Return the call that reads a step so many ticks ago."""
        width, length = ring_width(self.program, of), self.program.rings[of]
        self.done[f"ago_{width}"] += 1
        return f"ago_{width}(state->ring_{of}, state->at_{of}, {length}U, {ticks}U)"

    def _slide(self, step: int, of: int, ticks: int, most: int) -> str:
        """Write what brings a sum and its number of values to this tick, once."""
        key = sum_key(of, ticks, most)
        if key not in self._slid:
            self._slid.add(key)
            both, newest = f"&state->sum_{key}, &state->values_{key}", self.kept(of)
            if ticks:
                width = sum_type(self.program, of, most).removeprefix("int").removesuffix("_t")
                self.done[f"slide_{width}"] += 1
                self.lines.append(f"slide_{width}({both}, {self._ago(of, ticks)}, {newest});")
            else:
                self.done["gather"] += 1
                self.lines.append(f"gather({both}, {most}U, {newest});")
        counts = operation_of(self.program.steps[step]) == "values"
        return f"(int32_t)state->values_{key}" if counts else f"state->sum_{key}"

    def _set(self, step: int, value: str) -> str:
        return self._declare(integer_type(self.size(step)), "s", step, value)

    def _declare(self, kind: str, name: str, step: int, value: str) -> str:
        self.lines.append(f"const {kind} {name}_{step} = {value};")
        return f"{name}_{step}"


_TAKEN = ("signal", "fact", "number", "ago")

_COMPUTED: Mapping[str, Callable[..., str]] = {
    **dict.fromkeys(_TAKEN, StepWriter._given_or_past),
    "constant": lambda _writer, _step, value: literal(value),
    "where": lambda writer, _step, of, _condition: writer.value(of),
    "at_least": lambda writer, _step, of, _least: writer.value(of),
    "clip": StepWriter._clipped,
    "else": StepWriter._chosen,
    "//": StepWriter._truncated,
    "nearest": StepWriter._nearest,
    "sum": StepWriter._slide,
    "values": StepWriter._slide,
}
"""What computes an operation that is more than a text of what it works on."""

_WRITTEN = {
    "+": "{0} + {1}",
    "-": "{0} - {1}",
    "*": "{0} * {1}",
    "min": "smaller({0}, {1})",
    "max": "larger({0}, {1})",
    "max_64": "larger_64({0}, {1})",
    "power": "power_of_two({0}, {1})",
    "negative": "-{0}",
    "abs": "({0} < 0) ? -{0} : {0}",
    "sign": "sign({0})",
}
"""What an operation is in C, of what it works on."""


def _positive(writer: StepWriter, step: int) -> str:
    _, divisor = plain_of(writer.program.steps[step])
    return f"({writer.value(divisor)} > 0)"


def _enough(writer: StepWriter, step: int) -> str:
    a, b = plain_of(writer.program.steps[step])
    return f"({writer.value(a)} >= {writer.value(b)})"


def _either(writer: StepWriter, step: int) -> str:
    a, b = plain_of(writer.program.steps[step])
    return f"({writer.there(a)}) || ({writer.there(b)})"


_PRESENT: Mapping[str, Callable[[StepWriter, int], str]] = {
    "//": _positive,
    "nearest": _positive,
    "at_least": _enough,
    "else": _either,
}
"""Whether a step is there by itself."""


def sum_key(of: int, ticks: int, most: int) -> str:
    """Return what a sum is called: of which step, over so many ticks, or of so many values."""
    return f"{of}_over_{ticks}" if ticks else f"{of}_of_{most}"


def sum_type(program: Steps, of: int, most: int) -> str:
    """Return the type of a sum of so many values."""
    return integer_type(size_of(program.ranges[of]) * most)


def ring_width(program: Steps, of: int) -> int:
    """Return the bits of a word of a ring: of its largest value, and one that is missing."""
    return 16 if size_of(program.ranges[of]) < 2**15 else 32


@dataclass(frozen=True)
class StateField:
    """A field of a struct: words of a type such as `int16_t`; an array if there are several."""

    type: str
    name: str
    words: int = 1
    array: bool = False
    comment: str = ""

    @property
    def word_bytes(self) -> int:
        """Bytes of a word, and what its address is a multiple of."""
        return int("".join(c for c in self.type if c.isdigit())) // 8

    @property
    def declared(self) -> str:
        """The field as it stands in C."""
        size = f"[{self.words}]" if self.array else ""
        comment = f" /* {self.comment} */" if self.comment else ""
        return f"{self.type} {self.name}{size};{comment}"


def state_fields(program: Steps) -> list[StateField]:
    """Return the fields of the state: rings of steps, sums, what the car knows."""
    names, found = field_names(program), []
    for of, ticks in program.rings.items():
        if ticks:
            kind = f"int{ring_width(program, of)}_t"
            found += [
                StateField(kind, f"ring_{of}", ticks, array=True, comment=f"step {of}"),
                StateField("uint32_t", f"at_{of}"),
            ]
    for of, ticks, most in program.sums:
        key, kind = sum_key(of, ticks, most), sum_type(program, of, most)
        found += [StateField(kind, f"sum_{key}"), StateField("uint32_t", f"values_{key}")]
    found += [StateField("int32_t", name) for name in (*names["facts"], *names["numbers"])]
    nothing = StateField("uint8_t", "nothing", comment="this model looks back on nothing")
    return found or [nothing]


def state_bytes(program: Steps) -> int:
    """Return the size of the state where a word of n bytes lies at a multiple of n, as on ARM."""
    fields, at = state_fields(program), 0
    for one in fields:
        at += -at % one.word_bytes + one.words * one.word_bytes
    return at + -at % max(one.word_bytes for one in fields)


LONGEST_NAME = 31
_HELPER = re.compile(r"^//: (\w+)\n", re.MULTILINE)
"""What stands before each function in `helpers.c`: what writes it, if it was done."""


def c_header(version: ModelVersion, program: Program) -> str:
    """Return the header: what is given, what is kept from tick to tick, and two functions."""
    return fill_in_version(
        "templates/estimator.h",
        version,
        program,
        scale_names=_scale_names(c_prefix(version).upper(), program),
        state=state_fields(program),
        outside=_outside(program),
    )


def _scale_names(upper: str, program: Program) -> Sequence[str]:
    """Return macros of what a count is worth, which the source does not use.

    They differ in their first 31 characters (MISRA C:2012, rule 5.4).
    """
    names = [f"{upper}_{one.name.upper()}_SCALE" for one in program.signals]
    cut = len({name[:LONGEST_NAME] for name in names}) < len(names)
    return different(names, LONGEST_NAME) if cut else names


def _outside(program: Program) -> Mapping[str, str]:
    """Return what tells that a field of a sample is beyond its range, unless nothing can be.

    No comparison that a count of 16 bits cannot fail: compilers warn of it.
    """
    found = {}
    for field, one in zip(field_names(program)["signals"], program.signals, strict=True):
        low = [f"(sample->{field} < {one.min_count})"] if one.min_count > -(2**15) + 1 else []
        high = [f"(sample->{field} > {one.max_count})"] if one.max_count < 2**15 - 1 else []
        found[field] = " || ".join(low + high)
    return {field: beyond for field, beyond in found.items() if beyond}


def c_source(version: ModelVersion, program: Program) -> str:
    """Return the source that goes with the header."""
    writer, angle = StepWriter(program), program.angle
    start = start_lines(program, writer) or ["state->nothing = 0U;"]
    terms, valid, lines = step_lines(program, writer)
    return fill_in_version(
        "templates/estimator.c",
        version,
        program,
        helpers=helper_texts(writer),
        start=start,
        learned=[sum_key(*one) for one in program.learned],
        lines=lines,
        looks_back=any("state->" in line for line in lines),
        kind=integer_type(max(writer.size(place) for place, _ in angle.terms)),
        terms=terms,
        shift=angle.bits - angle.low_bits,
        valid=valid,
    )


def helper_texts(writer: StepWriter) -> list[str]:
    """Return the functions that what was written calls."""
    _, *named = _HELPER.split(read_source("templates/helpers.c"))
    texts = zip(named[::2], named[1::2], strict=True)
    return [text.strip("\n") + "\n" for name, text in texts if writer.done[name]]


def start_lines(program: Steps, writer: StepWriter) -> list[str]:
    """Return the statements that begin a drive."""
    fields, lines = field_names(program), []
    for of, ticks in program.rings.items():
        if ticks:
            empty = "INT16_MIN" if ring_width(program, of) == 16 else "MISSING"
            lines += [
                f"for (uint32_t i = 0U; i < {ticks}U; i++) {{",
                f"{INDENT}state->ring_{of}[i] = {empty};",
                "}",
                f"state->at_{of} = 0U;",
            ]
    for one in program.sums:
        key = sum_key(*one)
        lines += [f"state->sum_{key} = 0;", f"state->values_{key} = 0U;"]
    ranges = [*program.given["fact"], *program.given["number"]]
    for field, (least, most) in zip((*fields["facts"], *fields["numbers"]), ranges, strict=True):
        writer.done["within"] += 1
        lines.append(f"state->{field} = within(car->{field}, {literal(least)}, {most});")
    return lines


def step_lines(program: Program, writer: StepWriter) -> tuple[list[str], str, list[str]]:
    """Return the columns of a tick, whether all are there, and the statements before these.

    The writer counts what they do, and what adds up the angle, as `fixed_point` proves.
    """
    places = [place for place, _ in program.angle.terms]
    terms, valid = [writer.value(place) for place in places], writer.there(*places)
    keeps = keep_lines(program, writer)
    writer.done.update({"floor_shift": 2, "clip": 1, "term": len(terms)})
    return terms, valid, [*writer.lines, *keeps]


def keep_lines(program: Steps, writer: StepWriter) -> list[str]:
    """Return the statements that write this tick into the rings, after all that is computed."""
    kept = {of: writer.kept(of) for of, ticks in program.rings.items() if ticks}
    found = []
    for of, value in kept.items():
        width = ring_width(program, of)
        writer.done[f"keep_{width}"] += 1
        ring = f"state->ring_{of}, &state->at_{of}, {program.rings[of]}U"
        found.append(f"keep_{width}({ring}, {value});")
    return found
