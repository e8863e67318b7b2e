"""A program in C99: a header and a source, in integers alone, without allocation or recursion."""

import re
from collections.abc import Sequence

from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.export.c.c_names import (
    INDENT,
    c_prefix,
    different,
    field_names,
    integer_type,
    literal,
    plain_text,
    read_template,
)
from fleet_slip.export.c.c_steps import StepWriter, ring_width, state_fields, sum_key
from fleet_slip.export.program import Program, Steps
from fleet_slip.export.read_me import AXES
from fleet_slip.models.model_version import ModelVersion

LONGEST_NAME = 31
_HELPER = re.compile(r"^//: (\w+)\n", re.MULTILINE)
"""What stands before each function in `helpers.c`: what writes it, if it was done."""


def c_header(version: ModelVersion, program: Program) -> str:
    """Return the header: what is given, what is kept from tick to tick, and two functions."""
    prefix, upper = c_prefix(version), c_prefix(version).upper()
    car = _car(program)
    parts = [
        _preamble(version, program),
        f"#ifndef {upper}_H\n#define {upper}_H\n\n#include <stdbool.h>\n#include <stdint.h>\n",
        '#ifdef __cplusplus\nextern "C" {\n#endif\n',
        f'#define {upper}_MODEL "{version.reference}"\n'
        f'#define {upper}_SHA256 "{version.sha256}"\n'
        f'#define {upper}_DRIVES_SHA256 "{version.manifest.trained_on.told_by or ""}"\n',
        f"/* Axes: {AXES}. */\n" + "\n".join(_scales(upper, program)),
        "/* A count that is missing; one beyond its range is, too. */\n"
        f"#define {upper}_MISSING INT16_MIN\n",
        _struct(
            "Counts of one tick: physical = scale * count.", _sample(program), prefix, "sample"
        ),
    ]
    if car:
        parts += [
            f"/* What a car does not know. */\n#define {upper}_UNKNOWN INT32_MIN\n",
            _struct("What a car knows of itself.", car, prefix, "car"),
        ]
    return "\n".join(
        [
            *parts,
            _struct("What is kept from tick to tick.", _state(program), prefix, "state"),
            _functions(prefix, program),
            _outside(prefix, program),
            "#ifdef __cplusplus\n}\n#endif\n",
            "#endif\n",
        ]
    )


def _scales(upper: str, program: Program) -> list[str]:
    """Return macros of the tick and of what a count is worth, which the source does not use.

    Names differ in their first 31 characters (MISRA C:2012, rule 5.4).
    """
    names = [f"{upper}_{one.name.upper()}_SCALE" for one in program.signals]
    if len({name[:LONGEST_NAME] for name in names}) < len(names):
        names = [*different(names, LONGEST_NAME)]
    rows = [
        f"#define {name} {one.scale:f} /* {plain_unit(one.unit)} */"
        for name, one in zip(names, program.signals, strict=True)
    ]
    angle = program.angle
    return [
        f"#define {upper}_TICK_S {float(SAMPLE_TIME_S):g}",
        *rows,
        f"#define {upper}_ANGLE_SCALE {angle.scale:f} /* {plain_unit(angle.unit)} */\n",
    ]


def _functions(prefix: str, program: Program) -> str:
    angle = program.angle
    return (
        f"/* Begins a drive. */\n{_start_line(prefix, program)};\n\n"
        f"/* Takes the next tick, and writes {angle.column} in counts of {angle.scale:f}\n"
        f" * {angle.unit}, within {float(angle.error):.12f} counts of the exact model.\n"
        " * Returns whether there is an angle; else 0 is written. Call it at every tick: one\n"
        f" * without a message is a sample of missing counts. */\n{_step_line(prefix)};\n"
    )


def _outside(prefix: str, program: Program) -> str:
    """Return what counts inputs beyond their ranges; inline: who does not call it has none."""
    fields = field_names(program)["signals"]
    members = [f"uint32_t {field};" for field in fields]
    lines: list[str] = []
    for field, one in zip(fields, program.signals, strict=True):
        count, times = f"sample->{field}", f"outside->{field}"
        # No comparison that a count of 16 bits cannot fail: compilers warn of it.
        low = [f"({count} < {one.min_count})"] if one.min_count > -(2**15) + 1 else []
        high = [f"({count} > {one.max_count})"] if one.max_count < 2**15 - 1 else []
        if not (beyond := " || ".join(low + high)):
            continue
        lines += [
            f"if (({count} != INT16_MIN) && ({beyond}) && ({times} < UINT32_MAX)) {{",
            f"{INDENT}{times}++;",
            "}",
        ]
    unused = ["(void)outside;", "(void)sample;"]
    body = "\n".join(INDENT + line for line in lines or unused)
    told = "How often each input was there, but beyond its range. Begin with zeros."
    given = f"{prefix}_outside *outside, const {prefix}_sample *sample"
    return (
        f"{_struct(told, members, prefix, 'outside')}\n"
        "/* Counts what a tick has beyond the ranges; no angle depends on it. */\n"
        f"static inline void {prefix}_count_outside({given})\n{{\n{body}\n}}\n"
    )


def _start_line(prefix: str, program: Program) -> str:
    given = f", const {prefix}_car *car" if program.facts or program.numbers else ""
    return f"void {prefix}_start({prefix}_state *state{given})"


def _step_line(prefix: str) -> str:
    given = f"const {prefix}_sample *sample, int32_t *angle"
    return f"bool {prefix}_step({prefix}_state *state, {given})"


def _sample(program: Program) -> list[str]:
    return sample_lines(program, "int16_t")


def sample_lines(program: Steps, kind: str) -> list[str]:
    """Return the fields of a sample: a count of each signal."""
    return [
        f"{kind} {field}; /* {one.scale:f} {plain_unit(one.unit)}, "
        f"{one.min_count} to {one.max_count} */"
        for one, field in zip(program.signals, field_names(program)["signals"], strict=True)
    ]


def _car(program: Program) -> list[str]:
    fields = field_names(program)
    return [
        f"int32_t {field}; /* {'whole number' if one.equals is None else '1 or 0'} */"
        for one, field in zip(program.facts, fields["facts"], strict=True)
    ] + [
        f"int32_t {field}; /* {one.grain:f} {plain_unit(one.unit)} */"
        for one, field in zip(program.numbers, fields["numbers"], strict=True)
    ]


def c_source(version: ModelVersion, program: Program) -> str:
    """Return the source that goes with the header."""
    prefix, writer = c_prefix(version), StepWriter(program)
    start, step = _start(prefix, program, writer), _step(prefix, program, writer)
    return "\n".join(
        [
            _preamble(version, program),
            f'#include "{prefix}.h"\n',
            "#define MISSING INT32_MIN\n",
            *helper_texts(writer),
            start,
            step,
        ]
    )


def helper_texts(writer: StepWriter) -> list[str]:
    """Return the functions that what was written calls."""
    _, *named = _HELPER.split(read_template("helpers.c").template)
    texts = zip(named[::2], named[1::2], strict=True)
    return [text.strip("\n") + "\n" for name, text in texts if writer.done[name]]


def plain_unit(unit: str) -> str:
    """Return a unit as it may stand in a comment."""
    return plain_text(unit.replace("/", " per ").replace("*", " "))


def _preamble(version: ModelVersion, program: Program) -> str:
    trained, angle = version.manifest.trained_on, program.angle
    return (
        f"/* {version.reference}: {angle.column}, exported by fleet-slip. Do not edit.\n"
        f" * SHA-256 of the version: {version.sha256}\n"
        f" * Trained on {trained.drives} drives, SHA-256 {trained.told_by or 'unknown'}\n"
        " */"
    )


def _struct(comment: str, members: Sequence[str], prefix: str, name: str) -> str:
    body = "\n".join(INDENT + member for member in members)
    return f"/* {comment} */\ntypedef struct {{\n{body}\n}} {prefix}_{name};\n"


def _state(program: Program) -> list[str]:
    return [one.declared for one in state_fields(program)]


def _start(prefix: str, program: Program, writer: StepWriter) -> str:
    lines = start_lines(program, writer) or ["state->nothing = 0U;"]
    body = "\n".join(INDENT + line for line in lines)
    return f"{_start_line(prefix, program)}\n{{\n{body}\n}}\n"


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


def _tables(program: Program) -> list[str]:
    """Return the coefficients, each as an upper and a lower part."""
    (_, *parts), bits = program.angle.parts, program.angle.low_bits
    lines = [f"/* Coefficients over 2^{program.angle.bits}: upper * 2^{bits} + lower. */"]
    for which, name in enumerate(("upper", "lower")):
        rows = [
            ", ".join(str(part[which]) for part in parts[i : i + 6])
            for i in range(0, len(parts), 6)
        ]
        lines += [
            f"static const int32_t {name}[{len(parts)}] = {{",
            *(f"{INDENT}{row}," for row in rows[:-1]),
            f"{INDENT}{rows[-1]}",
            "};",
        ]
    return lines


def _step(prefix: str, program: Program, writer: StepWriter) -> str:
    body = "\n".join(INDENT + line for line in [*_tables(program), *step_lines(program, writer)])
    return f"{_step_line(prefix)}\n{{\n{body}\n}}\n"


def step_lines(program: Program, writer: StepWriter) -> list[str]:
    """Return the statements of a tick; the writer counts what they do."""
    places = [place for place, _ in program.angle.terms]
    terms, valid = [writer.value(place) for place in places], writer.there(*places)
    keeps = keep_lines(program, writer)
    lines = [*writer.lines, *keeps, *_dot(program, writer, terms, valid)]
    if not any("state->" in line for line in lines):
        lines.insert(-1, "(void)state;")
    return lines


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


def _dot(program: Program, writer: StepWriter, terms: Sequence[str], valid: str) -> list[str]:
    """Return statements that add up the angle, as `fleet_slip.export.fixed_point` proves."""
    angle = program.angle
    kind = integer_type(max(writer.size(place) for place, _ in angle.terms))
    (high, low), *_ = angle.parts
    shift = angle.bits - angle.low_bits
    writer.done.update({"floor_shift": 2, "clip": 1, "term": len(terms)})
    return [
        f"const {kind} term[{len(terms)}] = {{",
        *(f"{INDENT}{term}," for term in terms[:-1]),
        f"{INDENT}{terms[-1]}",
        "};",
        f"int64_t high = {literal(high)};",
        f"int64_t low = {literal(low)};",
        f"for (uint32_t i = 0U; i < {len(terms)}U; i++) {{",
        f"{INDENT}high += (int64_t)upper[i] * term[i];",
        f"{INDENT}low += (int64_t)lower[i] * term[i];",
        "}",
        f"high += floor_shift(low, {angle.low_bits}U) + {literal(2 ** (shift - 1))};",
        f"const bool valid = {valid};",
        f"*angle = valid ? clip(floor_shift(high, {shift}U), {angle.limit}) : 0;",
        "return valid;",
    ]
