"""Figures, formatted numbers, tables and templates of HTML pages.

Figures are drawn once, in the light colours. On the page every colour of the palette becomes a CSS
variable, so that the same drawing follows the reader's preference.
"""

import io
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

WIDTH_IN = 10.4
"""Width of a figure, such that its text at scale 1 has the size of small print on the page."""

BINS = int(WIDTH_IN * 72 / 1.5)
"""Number of bins of a series over the full width: one and a half points each."""


@dataclass(frozen=True)
class Colour:
    """One colour of the palette, for light and dark pages. No two have the same light one."""

    light: str
    dark: str


# After Okabe and Ito (2008): told apart by people with any kind of colour blindness, and darkened
# until text in these colours is legible on white.
PALETTE: Mapping[str, Colour] = {
    "surface": Colour("#ffffff", "#16191d"),
    "ink": Colour("#1b1f24", "#e8eaed"),
    "muted": Colour("#5a636e", "#a3acb7"),
    "grid": Colour("#dfe3e8", "#30363d"),
    "truth": Colour("#22272e", "#f2f4f6"),
    "model_1": Colour("#a86400", "#f0ad4e"),
    "model_2": Colour("#a8487f", "#f08fc8"),
    "model_3": Colour("#00775c", "#35c79b"),
    "model_4": Colour("#0067a8", "#58b0f2"),
    "model_5": Colour("#4c6fd0", "#9db4ff"),
    "kalman": Colour("#bf4a00", "#ff8b4d"),
    "kalman_tuned": Colour("#7a5c48", "#d0a98c"),
    "unstable": Colour("#b3261e", "#ff7a70"),
}

FONT = "DejaVu Sans"
"""Ships with matplotlib, so that figures are the same everywhere."""

STYLE: Any = {
    "svg.fonttype": "none",
    "font.family": FONT,
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlelocation": "left",
    "axes.edgecolor": PALETTE["muted"].light,
    "axes.labelcolor": PALETTE["muted"].light,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": PALETTE["grid"].light,
    "grid.linewidth": 0.6,
    "text.color": PALETTE["ink"].light,
    "xtick.color": PALETTE["muted"].light,
    "ytick.color": PALETTE["muted"].light,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.size": 3.0,
    "ytick.major.size": 0.0,
    "lines.linewidth": 1.0,
    "lines.solid_joinstyle": "round",
    "figure.facecolor": PALETTE["surface"].light,
    "axes.facecolor": "none",
    "savefig.facecolor": PALETTE["surface"].light,
}


def colour(name: str) -> str:
    """Return a colour of the palette for figures."""
    return PALETTE[name].light


@dataclass(frozen=True)
class Picture:
    """One figure of the report.

    Attributes
    ----------
    key
        Name of its files and of its anchor on the page.
    title, caption
        Subject, and result in numbers.
    seen
        Description for readers who cannot see it.
    draw
        Returns the figure.
    """

    key: str
    title: str
    caption: str
    seen: str
    draw: Callable[[], Figure]

    @property
    def alternative(self) -> str:
        """The text in place of the figure."""
        return f"{self.title}. {self.seen} {self.caption}"


PNG_DPI = 150
PIXELS_PER_POINT = 4 / 3


@dataclass(frozen=True)
class Drawn:
    """A rendered picture: for the page, and as separate files on a light ground."""

    picture: Picture
    svg: Markup
    svg_file: str
    png_file: bytes


def draw(picture: Picture) -> Drawn:
    """Render a picture."""
    png, stream = io.BytesIO(), io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": picture.key}):
        figure = picture.draw()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
        figure.savefig(png, format="png", dpi=PNG_DPI, metadata={"Software": None})
    svg = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", stream.getvalue(), flags=re.DOTALL)
    svg = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), svg)
    return Drawn(
        picture,
        Markup(inline(svg, picture.key, picture.alternative)),  # noqa: S704
        svg.replace(f"'{FONT}'", f"'{FONT}', Verdana, sans-serif"),
        png.getvalue(),
    )


def inline(svg: str, prefix: str, alternative: str) -> str:
    """Return an SVG document as part of a page.

    Prefixes its ids, so that they differ from other figures'; replaces its colours and font by
    variables of the page, and its ground by none.
    """
    body = re.sub(
        r"<defs>\s*<style.*?</style>\s*</defs>", "", svg[svg.index("<svg") :], flags=re.DOTALL
    )
    body = re.sub(r'\bid="', f'id="{prefix}-', body)
    body = re.sub(r"url\(#", f"url(#{prefix}-", body)
    body = re.sub(r'href="#', f'href="#{prefix}-', body)
    body = re.sub(r"(font: [^;\"']*?\d(?:px|pt)) [^;\"]*", r"\1 var(--figure-font)", body)
    body = re.sub(r"font-family: [^;\"]*", "font-family: var(--figure-font)", body)
    for name, tone in PALETTE.items():
        value = "transparent" if name == "surface" else f"var(--{name.replace('_', '-')})"
        body = body.replace(tone.light, value)
    width, height = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', body).groups()  # type: ignore[union-attr]
    largest = f"max-width: {float(width) * PIXELS_PER_POINT:.0f}px"
    head = (
        f'<svg role="img" aria-label="{escape(alternative)}" viewBox="0 0 {width} {height}" '
        f'xmlns:xlink="http://www.w3.org/1999/xlink" style="{largest}">'
    )
    return head + body[body.index(">") + 1 :]


# Numbers, texts and tables.


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
    """A table cell that is marked as good."""

    mark = "good"


@dataclass(frozen=True)
class ReportTable:
    """A table with a caption; the first `text_columns` columns are text, the others are numbers."""

    key: str
    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1
    note: str = ""


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
