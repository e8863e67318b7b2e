"""What the TOML files of the report are written in: Jinja, with numbers as pages show them."""

import tomllib
from collections.abc import Callable
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined

from fleet_slip.pages import page_parts as text

TEXTS = Environment(undefined=StrictUndefined, keep_trailing_newline=True)  # noqa: S701 - no HTML
TEXTS.filters |= {
    one.__name__: one
    for one in (
        text.count, text.degrees, text.listed, text.number, text.percent, text.scientific, text.size
    )
}  # fmt: skip


def read_toml(name: str) -> dict[str, Any]:
    """Return the content of a TOML file of the report."""
    return tomllib.loads((files(__package__) / name).read_text(encoding="utf-8"))


def expression(source: str) -> Callable[..., Any]:
    """Return what computes an expression of words."""
    return TEXTS.compile_expression(source, undefined_to_none=False)
