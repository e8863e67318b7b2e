"""The files of an export are templates that are filled in with a version and its program.

A template has `${expressions}`, and after `//%` a statement on a line of its own (Jinja).
"""

import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

from fleet_slip.base import sha256_of
from fleet_slip.catalog.signals import SAMPLE_TIME_S
from fleet_slip.export.program import Program, Steps
from fleet_slip.models.registry import ModelVersion

if TYPE_CHECKING:
    from jinja2 import Environment


# Names and numbers of a program as C has them.

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


AXES = "x forward, y left, z up; angles and yaw rate are positive to the left (ISO 8855)"


def read_source(name: str) -> str:
    """Return a file of this folder as it is."""
    return (files("fleet_slip.export") / name).read_text("utf-8")


def fill_template(name: str, **words: Any) -> str:
    """Return a template of this folder with its words."""
    return _environment().get_template(name).render(words)


def fill_in_version(name: str, version: ModelVersion, program: Program, **more: Any) -> str:
    """Return a template with a version, its program and `more` words."""
    prefix, angle = c_prefix(version), program.angle
    return fill_template(
        name,
        version=version,
        trained=version.manifest.trained_on,
        program=program,
        angle=angle,
        most_angle=min(angle.largest, angle.limit) * angle.scale,
        prefix=prefix,
        upper=prefix.upper(),
        fields=field_names(program),
        knows=bool(program.facts or program.numbers),
        axes=AXES,
        tick_s=float(SAMPLE_TIME_S),
        **more,
    )


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, FunctionLoader, StrictUndefined  # noqa: PLC0415 - not for show

    environment = Environment(  # noqa: S701 - no HTML; what goes into XML is `quoted`
        loader=FunctionLoader(read_source),
        variable_start_string="${",
        variable_end_string="}",
        line_statement_prefix="//%",
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    environment.globals["zip"] = zip
    environment.filters |= {
        "decimal": lambda value: f"{value:f}",
        "given": lambda value, missing: missing if value is None else value,
        "literal": literal,
        "plain": plain_text,
        "quoted": quoteattr,
        "unit": plain_unit,
        "word": lambda count: "INT16_MIN" if count is None or abs(count) >= 2**15 else count,
    }
    return environment
