"""Names and numbers of a program as C has them."""

import re
from collections.abc import Sequence

from fleet_slip.export.program import Program

LARGEST_32 = 2**31 - 1


def field_names(program: Program) -> dict[str, tuple[str, ...]]:
    """Return the fields of a sample and of a car, none of which is a keyword of C."""
    return {
        "signals": tuple(f"{one.name}_count" for one in program.signals),
        "facts": different([f"fact_{one.field}" for one in program.facts]),
        "numbers": tuple(f"{one.name}_count" for one in program.numbers),
    }


def different(names: Sequence[str], longest: int | None = None) -> tuple[str, ...]:
    """Return names of which none stands twice; none is longer than that, if it is given."""
    found: list[str] = []
    for name in names:
        number, one = 1, name[:longest]
        while one in found:
            number += 1
            end = f"_{number}"
            one = name[: longest - len(end)] + end if longest else name + end
        found.append(one)
    return tuple(found)


def integer_type(largest: int) -> str:
    """Return the type of a word that holds a size and more than one missing value beside it."""
    return "int32_t" if largest <= LARGEST_32 else "int64_t"


def literal(value: int) -> str:
    """Return a constant, in parentheses if it is negative."""
    text = str(value) if abs(value) <= LARGEST_32 else f"INT64_C({abs(value)})"
    if value >= 0:
        return text
    return f"({value})" if abs(value) <= LARGEST_32 else f"(-{text})"


def plain_text(text: str) -> str:
    """Return a text that may stand in a string and in a comment: it may come from anywhere."""
    return re.sub(r"[^A-Za-z0-9 @_.:,^-]", "_", text)
