"""The files of an export are templates that are filled in with a version and its program.

A template has `${expressions}`, and after `//%` a statement on a line of its own (Jinja).
"""

from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.export.c.c_names import c_prefix, field_names, literal, plain_text, plain_unit
from fleet_slip.export.program import Program
from fleet_slip.models.model_version import ModelVersion

if TYPE_CHECKING:
    from jinja2 import Environment

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
