"""Components of HTML pages: formatted numbers, tables, templates."""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape

from fleet_slip.pages.drawing import PALETTE


def number(value: float | None, digits: int = 3, *, sign: bool = False) -> str:
    """Format a number with a true minus sign; a dash for None."""
    if value is None:
        return "\N{EN DASH}"
    text = f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def degrees(value: float | None, digits: int = 3, *, sign: bool = False) -> str:
    """Format an angle in degrees; a dash for None."""
    return number(value, digits, sign=sign) + ("" if value is None else "\N{DEGREE SIGN}")


def percent(share: float, digits: int = 0) -> str:
    """Format a fraction as a percentage."""
    return f"{number(100 * share, digits)} %"


def count(value: int) -> str:
    """Format an integer with thousands separators."""
    return f"{value:,}"


def scientific(value: float, digits: int = 2) -> str:
    """Format a number, as 1.23 × 10⁻⁴ if it is very small or large."""
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits + 1}g}".replace("-", "\N{MINUS SIGN}")
    mantissa, _, exponent = f"{value:.{digits}e}".partition("e")
    raised = str(int(exponent)).translate(_SUPERSCRIPTS)
    return f"{mantissa} × 10{raised}".replace("-", "\N{MINUS SIGN}")


_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def join_words(words: list[str]) -> str:
    """Join words as in a sentence: a, b and c."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


_CODE = re.compile(r"`([^`]+)`")
_PLACE = re.compile(r"(Figure|Table) (\d|II?\b)")
_TABLES = {"I": "1", "II": "2"}


def rich_text(text: str, present: Collection[str] = ()) -> Markup:
    """Return a text as HTML: code in backticks, and links to the figures and tables of the page.

    `present` are the keys of figures and tables on the page, such as figure-1a and table-1.
    """

    def link(match: re.Match[str]) -> str:
        kind, place = match[1].lower(), match[2]
        key = f"{kind}-{_TABLES.get(place, place)}"
        key = next((name for name in (key, f"{key}a") if name in present), "")
        return f'<a href="#{key}">{match[0]}</a>' if key else match[0]

    marked = _CODE.sub(r"<code>\1</code>", str(escape(text)))
    return Markup(_PLACE.sub(link, marked))  # noqa: S704 - the text is escaped


class Cell(str):
    """A table cell, marked as good."""

    mark: Literal["", "good"] = ""


@dataclass(frozen=True)
class ReportTable:
    """A table with a caption; the first `text_columns` columns are text, the others are numbers."""

    key: str
    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1
    note: str = ""


@dataclass(frozen=True)
class Tile:
    """One number of a page's summary."""

    value: str
    label: str


TEMPLATES = files("fleet_slip.pages") / "templates"


def fill_in(template: str, **values: Any) -> str:
    """Render a template with values, the style sheet and the colours of all pages."""
    environment = Environment(
        loader=FunctionLoader(lambda name: (TEMPLATES / name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["rich"] = rich_text
    page = environment.get_template(template).render(
        css=Markup((TEMPLATES / "report.css").read_text(encoding="utf-8")),  # noqa: S704
        palette={name.replace("_", "-"): tone for name, tone in PALETTE.items()},
        **values,
    )
    return page + "\n"
