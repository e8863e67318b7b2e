"""C99 of a program: integers only, no allocation, no recursion. The templates are in `templates/`.

A step is a constant of 32 or 64 bits, depending on its range, and 0 where it is missing. Steps that
can be missing by themselves have a bool. State words have the value `MISSING` instead.
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.base import Record, pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.columns.lowering import size_of
from fleet_slip.errors import FleetSlipError
from fleet_slip.export.program import Program, Steps, write_program
from fleet_slip.export.templating import (
    INDENT,
    MAX_32,
    c_prefix,
    distinct,
    field_names,
    fill_in_version,
    integer_type,
    literal,
    read_source,
)
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import ModelVersion

MAX_UNSIGNED = 2**32 - 1


class StepWriter:
    """Writes the statements of requested steps, each once, and counts their operations.

    Attributes
    ----------
    lines
        The statements.
    counts
        Number of calls of each helper and of each operation; `//64` is a division of 64 bits.
    """

    def __init__(self, program: Steps) -> None:
        self.program = program
        self.lines: list[str] = []
        self.counts: Counter[str] = Counter()
        self._roots = program.roots
        self._values: dict[int, str] = {}
        self._presence: dict[int, str] = {}
        self._words: dict[int, str] = {}
        self._updated_sums: set[str] = set()
        fields = field_names(program)
        signals = zip(program.signals, fields["signals"], strict=True)
        self._inputs = {
            "signal": [
                f"within(sample->{field}, {literal(signal.min_count)}, {literal(signal.max_count)})"
                for signal, field in signals
            ],
            "fact": [f"state->{field}" for field in fields["facts"]],
            "number": [f"state->{field}" for field in fields["numbers"]],
        }

    def value(self, step: int) -> str:
        """Return the value of a step in C; its statements are written first."""
        if step not in self._values:
            name, operands, plain = self.program.steps[step]
            write = _WRITERS.get(name, StepWriter._arithmetic)
            self._values[step] = write(self, step, *operands, *plain)
        return self._values[step]

    def is_present(self, *steps: int) -> str:
        """Return the condition that none of these steps is missing."""
        roots = dict.fromkeys(root for step in steps for root in self._roots[step])
        return " && ".join(self._is_root_present(root) for root in roots) or "true"

    def word(self, step: int) -> str:
        """Return a step as a state word: `MISSING` if it is missing."""
        if self.program.steps[step].name in _INPUTS:
            return self._input_word(step)
        value = self.value(step)
        return f"(({self.is_present(step)}) ? {value} : MISSING)"

    def size(self, step: int) -> int:
        """Return the largest absolute value of a step."""
        return size_of(self.program.ranges[step])

    def _is_root_present(self, root: int) -> str:
        """Return the bool that is false where a step is missing by itself."""
        if root not in self._presence:
            name, operands, _ = self.program.steps[root]
            if name in _INPUTS:
                present = f"({self._input_word(root)} != MISSING)"
            elif name == "else":
                present = " || ".join(f"({self.is_present(operand)})" for operand in operands)
            elif name == "at_least":
                present = f"({self.value(operands[0])} >= {self.value(operands[1])})"
            else:
                present = f"({self.value(operands[1])} > 0)"
            self._presence[root] = self._declare("bool", "has", root, present)
        return self._presence[root]

    def _arithmetic(self, step: int, *operands: int) -> str:
        name = self.program.steps[step].name
        values = [self.value(operand) for operand in operands]
        if name == "*" and "1" in values:
            return values[values[0] == "1"]
        is_wide = max(map(self.size, (step, *operands))) > MAX_32
        if name in ("min", "max") and is_wide:
            name = f"{name}_64"
        self.counts[name] += 1
        if name in "+-*" and self.size(step) > MAX_32 >= max(map(self.size, operands)):
            values[0] = f"(int64_t){values[0]}"
        text = _OPERATIONS[name].format(*values)
        return self._set(step, text, wide=name in ("min_64", "max_64"))

    def _shift(self, step: int, source: int, bits: int) -> str:
        self.counts["shift"] += 1
        return self._set(step, f"shifted({self.value(source)}, {bits}U)", wide=True)

    def _clip(self, step: int, source: int, bound: int) -> str:
        value, limit = self.value(source), self.size(bound)
        if self.size(source) <= limit:
            return value
        name = "clip" if limit <= MAX_32 else "clip_64"
        self.counts[name] += 1
        return self._set(step, f"{name}({value}, {literal(limit)})")

    def _else(self, step: int, a: int, b: int) -> str:
        first, second = self.value(a), self.value(b)
        return self._set(step, f"({self.is_present(a)}) ? {first} : {second}")

    def _truncate(self, step: int, a: int, b: int) -> str:
        wide = max(self.size(a), self.size(b)) > MAX_32
        quotient = f"{self.value(a)} / {self._divisor(step, b)}"
        self.counts["//64" if wide else "//"] += 1
        if wide and self.size(step) <= MAX_32:
            quotient = f"({quotient})"
        return self._set(step, quotient, wide=wide)

    def _nearest(self, step: int, a: int, b: int) -> str:
        value = self.value(a)
        if self.program.ranges[b] == (1, 1):
            return value
        divisor, wide = self._divisor(step, b), 2 * self.size(a) + self.size(b) > MAX_UNSIGNED
        self.counts["nearest_64" if wide else "nearest_32"] += 1
        if not wide:
            divisor = f"{divisor}U" if divisor.isdigit() else f"(uint32_t){divisor}"
        return self._set(step, f"nearest_{64 if wide else 32}({value}, {divisor})", wide=wide)

    def _divisor(self, step: int, source: int) -> str:
        """Return a divisor; 1 where the quotient is missing."""
        divisor = self.value(source)
        if self.program.ranges[source][0] > 0:
            return divisor
        return f"({self._is_root_present(step)} ? {divisor} : 1)"

    def _input(self, step: int, *_: int) -> str:
        return self._set(step, f"{self._is_root_present(step)} ? {self._input_word(step)} : 0")

    def _input_word(self, step: int) -> str:
        """Return an input, or a value of an earlier tick, as a word that can be `MISSING`."""
        if step not in self._words:
            name, operands, plain = self.program.steps[step]
            self.counts["within"] += name == "signal"
            is_past = name == "ago"
            word = self._ago(*operands, *plain) if is_past else self._inputs[name][plain[0]]
            self._words[step] = self._declare("int32_t", "in", step, word)
        return self._words[step]

    def _ago(self, source: int, ticks: int) -> str:
        """Return the call that reads a step a number of ticks ago."""
        width, length = ring_width(self.program, source), self.program.rings[source]
        self.counts[f"ago_{width}"] += 1
        return f"ago_{width}(state->ring_{source}, state->at_{source}, {length}U, {ticks}U)"

    def _sum(self, step: int, source: int, ticks: int, limit: int) -> str:
        """Write the update of a sum and its number of values to this tick, once."""
        key = sum_key(source, ticks, limit)
        if key not in self._updated_sums:
            self._updated_sums.add(key)
            both, newest = f"&state->sum_{key}, &state->values_{key}", self.word(source)
            if ticks:
                width = sum_type(self.program, source, limit).removeprefix("int").removesuffix("_t")
                self.counts[f"slide_{width}"] += 1
                self.lines.append(f"slide_{width}({both}, {self._ago(source, ticks)}, {newest});")
            else:
                self.counts["gather"] += 1
                self.lines.append(f"gather({both}, {limit}U, {newest});")
        counts = self.program.steps[step].name == "values"
        return f"(int32_t)state->values_{key}" if counts else f"state->sum_{key}"

    def _set(self, step: int, value: str, *, wide: bool = False) -> str:
        """Declare the value of a step, narrowed from a `wide` one of 64 bits if possible."""
        if wide and self.size(step) <= MAX_32:
            value = f"(int32_t){value}"
        return self._declare(integer_type(self.size(step)), "s", step, value)

    def _declare(self, kind: str, name: str, step: int, value: str) -> str:
        self.lines.append(f"const {kind} {name}_{step} = {value};")
        return f"{name}_{step}"


_INPUTS = ("signal", "fact", "number", "ago")

_WRITERS: Mapping[str, Callable[..., str]] = {
    **dict.fromkeys(_INPUTS, StepWriter._input),
    "constant": lambda _writer, _step, value: literal(value),
    "where": lambda writer, _step, source, _condition: writer.value(source),
    "at_least": lambda writer, _step, source, _bound: writer.value(source),
    "clip": StepWriter._clip,
    "else": StepWriter._else,
    "//": StepWriter._truncate,
    "nearest": StepWriter._nearest,
    "sum": StepWriter._sum,
    "values": StepWriter._sum,
    "shift": StepWriter._shift,
    "state": lambda writer, step, *_: writer._set(step, f"state->state_{step}"),
}
"""Writers of the operations that are not in `_OPERATIONS`."""

_OPERATIONS = {
    "+": "{0} + {1}",
    "-": "{0} - {1}",
    "*": "{0} * {1}",
    "min": "smaller({0}, {1})",
    "min_64": "smaller_64({0}, {1})",
    "max": "larger({0}, {1})",
    "max_64": "larger_64({0}, {1})",
    "power": "power_of_two({0}, {1})",
    "negative": "-{0}",
    "abs": "({0} < 0) ? -{0} : {0}",
    "sign": "sign({0})",
}
"""Operations of C, as texts of their operands."""


def sum_key(source: int, ticks: int, limit: int) -> str:
    """Return the name of a sum: its step, and its ticks or its maximum number of values."""
    return f"{source}_over_{ticks}" if ticks else f"{source}_of_{limit}"


def sum_type(program: Steps, source: int, limit: int) -> str:
    """Return the type of a sum of at most `limit` values."""
    return integer_type(size_of(program.ranges[source]) * limit)


def ring_width(program: Steps, source: int) -> int:
    """Return the bits of a ring's word, which holds the largest value and a missing one."""
    return 16 if size_of(program.ranges[source]) < 2**15 else 32


@dataclass(frozen=True)
class StateField:
    """A field of a struct: a word of a type such as `int16_t`, or an array of `length` words.

    `start` is the value at the start of a drive.
    """

    type: str
    name: str
    start: str = "0"
    length: int | None = None
    comment: str = ""

    @property
    def word_bytes(self) -> int:
        """Size and alignment of a word, in bytes."""
        return int("".join(c for c in self.type if c.isdigit())) // 8

    @property
    def declared(self) -> str:
        """Declaration in C."""
        size = f"[{self.length}]" if self.length else ""
        comment = f" /* {self.comment} */" if self.comment else ""
        return f"{self.type} {self.name}{size};{comment}"


def state_fields(program: Steps) -> list[StateField]:
    """Return the fields of the state: rings of steps, sums, and properties of the car."""
    names, fields = field_names(program), []
    for source, ticks in program.rings.items():
        if ticks:
            width = ring_width(program, source)
            empty = "INT16_MIN" if width == 16 else "MISSING"
            fields += [
                StateField(f"int{width}_t", f"ring_{source}", empty, ticks, f"step {source}"),
                StateField("uint32_t", f"at_{source}", "0U"),
            ]
    for source, ticks, limit in program.sums:
        key, kind = sum_key(source, ticks, limit), sum_type(program, source, limit)
        fields += [StateField(kind, f"sum_{key}"), StateField("uint32_t", f"values_{key}", "0U")]
    fields += [
        StateField(integer_type(size_of(program.ranges[step])), f"state_{step}")
        for step in program.states
    ]
    ranges = [*program.input_ranges["fact"], *program.input_ranges["number"]]
    for name, (low, high) in zip((*names["facts"], *names["numbers"]), ranges, strict=True):
        start = f"within(car->{name}, {literal(low)}, {high})"
        fields.append(StateField("int32_t", name, start))
    nothing = StateField("uint8_t", "nothing", "0U", comment="this model has no state")
    return fields or [nothing]


def state_bytes(program: Steps) -> int:
    """Return the size of the state if a word of n bytes is aligned to n bytes, as on ARM."""
    fields, size = state_fields(program), 0
    for field in fields:
        size += -size % field.word_bytes + (field.length or 1) * field.word_bytes
    return size + -size % max(field.word_bytes for field in fields)


MAX_NAME_CHARACTERS = 31
"""Significant characters of a name in C99."""
_HELPER = re.compile(r"^//: (\w+)\n", re.MULTILINE)
"""Heading of a function in `helpers.c`: the counted operation that needs it."""


def c_header(version: ModelVersion, program: Program) -> str:
    """Return the header: inputs, state, and functions."""
    upper = c_prefix(version).upper()
    # The source does not use these macros. Their first 31 characters differ (MISRA C:2012, 5.4).
    scale_names: Sequence[str] = [
        f"{upper}_{signal.name.upper()}_SCALE" for signal in program.signals
    ]
    if len({name[:MAX_NAME_CHARACTERS] for name in scale_names}) < len(scale_names):
        scale_names = distinct(scale_names, MAX_NAME_CHARACTERS)
    outside = {}
    for field, signal in zip(field_names(program)["signals"], program.signals, strict=True):
        # Compilers warn of comparisons that are always true for 16 bits.
        low, high = signal.min_count, signal.max_count
        tests = [f"(sample->{field} < {low})"] if low > -(2**15) + 1 else []
        tests += [f"(sample->{field} > {high})"] if high < 2**15 - 1 else []
        if tests:
            outside[field] = " || ".join(tests)
    return fill_in_version(
        "templates/estimator.h",
        version,
        program,
        scale_names=scale_names,
        state=state_fields(program),
        outside=outside,
    )


def c_source(version: ModelVersion, program: Program) -> str:
    """Return the source of the header."""
    writer, angle = StepWriter(program), program.angle
    start = start_lines(program, writer)
    terms, valid, lines = step_lines(program, writer)
    return fill_in_version(
        "templates/estimator.c",
        version,
        program,
        helpers=helper_texts(writer),
        start=start,
        learned=[sum_key(*window) for window in program.learned],
        lines=lines,
        looks_back=any("state->" in line for line in lines),
        kind=integer_type(max(writer.size(place) for place, _ in angle.terms)),
        terms=terms,
        shift=angle.bits - angle.low_bits,
        valid=valid,
    )


def helper_texts(writer: StepWriter) -> list[str]:
    """Return the functions that the written statements call."""
    _, *named = _HELPER.split(read_source("templates/helpers.c"))
    texts = zip(named[::2], named[1::2], strict=True)
    return [text.strip("\n") + "\n" for name, text in texts if writer.counts[name]]


def start_lines(program: Steps, writer: StepWriter) -> list[str]:
    """Return the statements at the start of a drive."""
    writer.counts["within"] += len(program.facts) + len(program.numbers)
    lines = []
    for field in state_fields(program):
        if field.length:
            lines += [
                f"for (uint32_t i = 0U; i < {field.length}U; i++) {{",
                f"{INDENT}state->{field.name}[i] = {field.start};",
                "}",
            ]
        else:
            lines.append(f"state->{field.name} = {field.start};")
    return lines


def step_lines(program: Program, writer: StepWriter) -> tuple[list[str], str, list[str]]:
    """Return the columns of a tick, the condition that none is missing, and the statements.

    The writer counts the operations of the statements and of the dot product.
    """
    places = [place for place, _ in program.angle.terms]
    terms, valid = [writer.value(place) for place in places], writer.is_present(*places)
    keeps = keep_lines(program, writer)
    writer.counts.update({"floor_shift": 2, "clip": 1, "term": len(terms)})
    return terms, valid, [*writer.lines, *keeps]


def keep_lines(program: Steps, writer: StepWriter) -> list[str]:
    """Return the statements that write this tick into the rings, after all steps are computed."""
    words = {source: writer.word(source) for source, ticks in program.rings.items() if ticks}
    values = {step: writer.value(following) for step, following in program.states.items()}
    lines = [f"state->state_{step} = {value};" for step, value in values.items()]
    for source, word in words.items():
        width = ring_width(program, source)
        writer.counts[f"keep_{width}"] += 1
        ring = f"state->ring_{source}, &state->at_{source}, {program.rings[source]}U"
        lines.append(f"keep_{width}({ring}, {word});")
    return lines


# Costs of an estimator in a car, counted from its integer program.
#
# The counts are those of the C export at a tick without missing values, which is the maximum. Size
# of the code and instructions depend on the compiler: they are estimates for a Cortex-M4, which
# `python -m benchmarks.on_board` compares with measurements.

COEFFICIENT_BYTES = 8
"""Size of a coefficient: two words of 32 bits."""


@dataclass(frozen=True)
class Costs(Record):
    """Costs of one estimate.

    Attributes
    ----------
    columns
        Terms of the dot product.
    coefficient_bytes, memory_bytes
        Size of the coefficients, and of the state: ring buffers, sums, numbers of values.
    multiplications, additions, divisions
        Operations of a tick, at most. Subtractions count as additions. Comparisons, shifts,
        absolute values and signs do not count.
    divisions_64
        Divisions that need 64 bits, which small processors lack.
    estimated_code_bytes, estimated_instructions
        Code and constants, and instructions of a tick, on a Cortex-M4; at or above measurements.
    """

    DOCUMENT = "... operations"

    columns: int
    coefficient_bytes: int
    memory_bytes: int
    multiplications: int
    additions: int
    divisions: int
    divisions_64: int
    estimated_code_bytes: int
    estimated_instructions: int

    @property
    def operations(self) -> int:
        """Multiplications, additions and divisions."""
        return self.multiplications + self.additions + self.divisions

    def __str__(self) -> str:
        """Return the text that `show` prints."""
        return (
            f"{pluralize(self.columns, 'column')}: {self.coefficient_bytes:,} bytes of "
            f"coefficients, {pluralize(self.memory_bytes, 'byte')} of memory; "
            f"{self.multiplications} multiplications, {self.additions} additions, "
            f"{self.divisions} divisions an estimate"
        )


def cost_on_board(catalog: Catalog, manifest: Manifest) -> Costs:
    """Count the costs of a published version. Raises as `write_program`."""
    return count_costs(write_program(catalog, manifest))


def count_costs(program: Program) -> Costs:
    """Count the costs of a program at a tick."""
    writer, terms = StepWriter(program), len(program.angle.terms)
    step_lines(program, writer)
    counts = writer.counts
    total = {
        kind: sum(n * _COSTS.get(name, {}).get(kind, 0) for name, n in counts.items())
        for kind in ("*", "+", "//", "//64")
    }
    return Costs(
        columns=terms,
        coefficient_bytes=COEFFICIENT_BYTES * terms,
        memory_bytes=state_bytes(program),
        multiplications=total["*"],
        additions=total["+"],
        divisions=total["//"],
        divisions_64=total["//64"],
        estimated_code_bytes=_estimate(_CODE_BYTES, counts)
        + (_DIVISION_BYTES if total["//64"] else 0),
        estimated_instructions=_estimate(_INSTRUCTIONS, counts),
    )


def dot_product_operations(terms: int) -> tuple[int, int]:
    """Return the multiplications and additions of a dot product of signals, as `show` counts them.

    A product of a count and a coefficient needs two multiplications of 32 bits.
    """
    term = _COSTS["term"]
    rounding = _COSTS["shift"]["+"] + _COSTS["floor_shift"]["+"]
    return term["*"] * terms, term["+"] * terms + rounding


def describe_costs(version: ModelVersion) -> str:
    """Describe the costs of a version, or the reason why it cannot run on board."""
    try:
        return str(cost_on_board(version.catalog, version.manifest))
    except FleetSlipError as error:
        return f"cannot be exported: {error}"


def costs_content(version: ModelVersion) -> dict[str, Any]:
    """Return the costs of a version for a JSON document, or its `error`."""
    try:
        return cost_on_board(version.catalog, version.manifest).as_dict()
    except FleetSlipError as error:
        return {"error": str(error)}


_COSTS: Mapping[str, Mapping[str, int]] = {
    "*": {"*": 1},
    "+": {"+": 1},
    "-": {"+": 1},
    "negative": {"+": 1},
    "//": {"//": 1},
    "//64": {"//": 1, "//64": 1},
    "nearest_32": {"*": 2, "+": 1, "//": 1},
    "nearest_64": {"*": 2, "+": 1, "//": 1, "//64": 1},
    "ago_16": {"+": 2},
    "ago_32": {"+": 2},
    "slide_32": {"+": 4},
    "slide_64": {"+": 4},
    "gather": {"+": 2},
    "keep_16": {"+": 1},
    "keep_32": {"+": 1},
    "term": {"*": 2, "+": 2},
    "floor_shift": {"+": 1},
    "shift": {"+": 1},
}
"""Multiplications, additions and divisions of each helper and operation, at most."""

_ARITHMETIC = ("+", "-", "*", "//", "negative", "abs", "sign", "min", "max", "max_64", "clip")
_LONG = ("shift", "min_64", "clip_64")
_WINDOWS = ("ago_16", "ago_32", "slide_32", "slide_64", "keep_16", "keep_32", "gather")
_WIDE = ("//64", "nearest_64", "power")

_Weights = Sequence[tuple[int, Sequence[str]]]

_INSTRUCTIONS: tuple[int, _Weights] = (
    10,
    (
        (5, _ARITHMETIC),
        (10, _WINDOWS),
        (20, _LONG),
        (40, ("nearest_32",)),
        (125, _WIDE),
        (33, ("term",)),
    ),
)
"""Instructions of a tick, and of each operation.

The smallest weights that are about 5 % above the counts of qemu in ticks of the self-test. The code
was compiled by arm-none-eabi-gcc 12 with -Os, for 21 models: one of each kind of column, and models
of 2 to 24 columns.
"""

_CODE_BYTES: tuple[int, _Weights] = (
    95,
    (
        (46, ("within",)),
        (124, ("nearest_32",)),
        (290, _WIDE),
        (46, ("term",)),
        (7, _WINDOWS),
        (20, _LONG),
    ),
)
_DIVISION_BYTES = 920
"""Size of the compiler's division of 64 bits, which is linked once."""


def _estimate(weights: tuple[int, _Weights], counts: Counter[str]) -> int:
    constant, terms = weights
    return constant + sum(weight * counts[name] for weight, names in terms for name in names)
