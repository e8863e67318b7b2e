"""Templates of exported files, and names and numbers of a program as C has them.

A template has `${expressions}`, and statements of Jinja after `//%` on a line of their own.
"""

import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from fleet_slip.base import sha256_of
from fleet_slip.catalog.signals import SAMPLE_TIME_S
from fleet_slip.export.program import Program, Steps
from fleet_slip.models.registry import ModelVersion

if TYPE_CHECKING:
    from jinja2 import Environment


MAX_32 = 2**31 - 1

INDENT = "    "

MAX_PREFIX_CHARACTERS = 24
"""External names differ in their first 31 characters (C99; MISRA C:2012, rule 5.1), which are the
prefix, `_gram_` and one more."""


def file_prefix(version: ModelVersion) -> str:
    """Return the prefix of the names of a version's files, except for those in C."""
    return f"{version.manifest.label.signal}_{version.manifest.name}"


def c_prefix(version: ModelVersion) -> str:
    """Return the prefix of all names in C; a long one is shortened and gets a hash."""
    prefix = file_prefix(version)
    if len(prefix) <= MAX_PREFIX_CHARACTERS:
        return prefix
    return f"{prefix[: MAX_PREFIX_CHARACTERS - 7]}_{sha256_of(prefix)[:6]}"


def field_names(program: Steps) -> dict[str, tuple[str, ...]]:
    """Return the fields of a sample and of a car; none is a keyword of C."""
    return {
        "signals": tuple(f"{signal.name}_count" for signal in program.signals),
        "facts": distinct([f"fact_{fact.field}" for fact in program.facts]),
        "numbers": tuple(f"{number.name}_count" for number in program.numbers),
    }


def distinct(names: Sequence[str], max_length: int | None = None) -> tuple[str, ...]:
    """Return distinct names: repeated ones get a number, none is longer than `max_length`."""
    unique: list[str] = []
    for name in names:
        count, candidate = 1, name[:max_length]
        while candidate in unique:
            count += 1
            end = f"_{count}"
            candidate = name[: max_length - len(end)] + end if max_length else name + end
        unique.append(candidate)
    return tuple(unique)


def integer_type(largest: int) -> str:
    """Return the type of a word that holds a size, and values beyond it for missing ones."""
    return "int32_t" if largest <= MAX_32 else "int64_t"


def literal(value: int) -> str:
    """Return a constant in C, in parentheses if it is negative."""
    text = str(value) if abs(value) <= MAX_32 else f"INT64_C({abs(value)})"
    if value >= 0:
        return text
    return f"({value})" if abs(value) <= MAX_32 else f"(-{text})"


def plain_text(text: str) -> str:
    """Replace all characters of a text that are not safe in a string or a comment."""
    return re.sub(r"[^A-Za-z0-9 @_.:,^-]", "_", text)


AXES = "x forward, y left, z up; angles and yaw rate are positive to the left (ISO 8855)"


def read_source(name: str) -> str:
    """Read a file of this folder."""
    return (files("fleet_slip.export") / name).read_text("utf-8")


def fill_template(name: str, **words: Any) -> str:
    """Fill a template of this folder in."""
    return _environment().get_template(name).render(words)


def fill_in_version(name: str, version: ModelVersion, program: Program, **words: Any) -> str:
    """Fill a template in with a version, its program and `words`."""
    prefix, angle = c_prefix(version), program.angle
    return fill_template(
        name,
        version=version,
        trained=version.manifest.trained_on,
        program=program,
        angle=angle,
        max_angle=min(angle.largest, angle.limit) * angle.scale,
        prefix=prefix,
        upper=prefix.upper(),
        fields=field_names(program),
        has_car=bool(program.facts or program.numbers),
        axes=AXES,
        tick_s=float(SAMPLE_TIME_S),
        **words,
    )


@cache
def _environment() -> "Environment":
    from xml.sax.saxutils import quoteattr  # noqa: PLC0415 - not for show

    from jinja2 import Environment, FunctionLoader, StrictUndefined  # noqa: PLC0415

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
        "or_missing": lambda value, missing: missing if value is None else value,
        "literal": literal,
        "plain": plain_text,
        "quoted": quoteattr,
        "unit": lambda unit: plain_text(unit.replace("/", " per ").replace("*", " ")),
        "word": lambda count: "INT16_MIN" if count is None or abs(count) >= 2**15 else count,
    }
    return environment
