"""Names and numbers of a program as C has them."""

import re
from collections.abc import Sequence

from fleet_slip.canonical import sha256_of
from fleet_slip.export.program import Steps
from fleet_slip.models.model_version import ModelVersion

LARGEST_32 = 2**31 - 1

INDENT = "    "

LONGEST_PREFIX = 24
"""C99 tells external names apart by 31 characters, and so does rule 5.1 of MISRA C:2012. After the
prefix `_gram_` and one more do."""


def file_prefix(version: ModelVersion) -> str:
    """Return what the names of the files of a version begin with, but for those in C."""
    return f"{version.manifest.label.signal}_{version.manifest.name}"


def c_prefix(version: ModelVersion) -> str:
    """Return what all names in C and of its files begin with: shortened, with a hash, if long."""
    prefix = file_prefix(version)
    if len(prefix) <= LONGEST_PREFIX:
        return prefix
    return f"{prefix[: LONGEST_PREFIX - 7]}_{sha256_of(prefix)[:6]}"


def field_names(program: Steps) -> dict[str, tuple[str, ...]]:
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


def plain_unit(unit: str) -> str:
    """Return a unit as it may stand in a comment."""
    return plain_text(unit.replace("/", " per ").replace("*", " "))
