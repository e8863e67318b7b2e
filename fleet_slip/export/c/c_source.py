"""A program in C99, in integers alone, without allocation or recursion, and what goes with it.

The C stands in `templates/`.
"""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from fleet_slip.export.c.c_names import (
    INDENT,
    c_prefix,
    different,
    field_names,
    integer_type,
    literal,
)
from fleet_slip.export.c.c_steps import StepWriter, ring_width, state_fields, sum_key
from fleet_slip.export.fill_templates import fill_in_version, read_source
from fleet_slip.export.program import Program, Steps
from fleet_slip.models.model_version import ModelVersion

if TYPE_CHECKING:
    from fleet_slip.export.checks import Check  # compiled code: what `show` asks for has none

LONGEST_NAME = 31
_HELPER = re.compile(r"^//: (\w+)\n", re.MULTILINE)
"""What stands before each function in `helpers.c`: what writes it, if it was done."""


def c_header(version: ModelVersion, program: Program) -> str:
    """Return the header: what is given, what is kept from tick to tick, and two functions."""
    return fill_in_version(
        "c/templates/estimator.h",
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
        "c/templates/estimator.c",
        version,
        program,
        helpers=helper_texts(writer),
        start=start,
        lines=lines,
        looks_back=any("state->" in line for line in lines),
        kind=integer_type(max(writer.size(place) for place, _ in angle.terms)),
        terms=terms,
        shift=angle.bits - angle.low_bits,
        valid=valid,
    )


def c_self_test(version: ModelVersion, program: Program, checks: "Sequence[Check]") -> str:
    """Return the source of a program that ends with 0 if the angles of all checks agree."""
    total = sum(len(check.angles) for check in checks)
    name = "c/templates/self_test.c"
    return fill_in_version(name, version, program, checks=checks, total=total)


def c_fuzz_target(version: ModelVersion, program: Program) -> str:
    """Return a fuzz target for libFuzzer: a car, then samples, of any bytes."""
    return fill_in_version("c/templates/fuzz.c", version, program)


def a2l_text(version: ModelVersion, program: Program) -> str:
    """Return what a calibration tool measures: an A2L file (ASAM MCD-2 MC, ASAP2 1.71).

    It names symbols instead of addresses, which the tool takes from the linked program. Whose
    program it is declares the variables, under the names that stand there. Coefficients are
    constants inside of a function, which no tool could change.
    """
    return fill_in_version("c/templates/estimator.a2l", version, program)


def helper_texts(writer: StepWriter) -> list[str]:
    """Return the functions that what was written calls."""
    _, *named = _HELPER.split(read_source("c/templates/helpers.c"))
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
