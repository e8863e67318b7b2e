"""From a picture to files: SVG and PNG on their own, and SVG for the page."""

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.figure import Figure

from fleet_slip.pages.picture import Picture
from fleet_slip.pages.style import DESK, FONT, PALETTE, PHONE, STYLE, Size

PNG_DPI = 150
PIXELS_PER_POINT = 4 / 3


@dataclass(frozen=True)
class Drawn:
    """A picture with its drawings for the page."""

    picture: Picture
    svgs: Mapping[str, Markup]


def draw(picture: Picture) -> Drawn:
    """Return a picture with its drawings for the page."""
    return Drawn(picture, {kind: Markup(svg) for kind, svg in inline_svgs(picture).items()})  # noqa: S704


def svg_file(picture: Picture) -> str:
    """Return the picture as an SVG file of its own, on a light ground."""
    svg = _lean(_svg(picture, DESK))
    return svg.replace(f"'{FONT}'", f"'{FONT}', Verdana, sans-serif")


def png_file(picture: Picture) -> bytes:
    """Return the picture as a PNG file."""
    stream = io.BytesIO()
    with mpl.rc_context(STYLE):
        picture.draw(DESK).savefig(stream, format="png", dpi=PNG_DPI, metadata={"Software": None})
    return stream.getvalue()


def inline_svgs(picture: Picture) -> dict[str, str]:
    """Return the picture for the page, by class: once for desks, once for phones."""
    return {
        "desk": inline(_lean(_svg(picture, DESK)), f"{picture.key}-desk", picture.alternative),
        "phone": inline(_lean(_svg(picture, PHONE)), f"{picture.key}-phone", picture.alternative),
    }


def _svg(picture: Picture, size: Size) -> str:
    stream = io.StringIO()
    settings: Any = {**STYLE, "svg.hashsalt": f"{picture.key}-{size.wide}"}
    with mpl.rc_context(settings):
        figure: Figure = picture.draw(size)
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return stream.getvalue()


def _lean(svg: str) -> str:
    """Drop comments and metadata, and keep a hundredth of a point of each coordinate."""
    svg = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' d="([^"]*)"', lambda found: f' d="{_short(found[1])}"', svg)
    return re.sub(r"\n\s*\n+", "\n", svg)


def _short(path: str) -> str:
    rounded = re.sub(
        r"-?\d+\.\d+", lambda found: f"{float(found[0]):.2f}".rstrip("0").rstrip("."), path
    )
    return re.sub(r"\s*([A-Za-z])\s*", r"\1", " ".join(rounded.split()))


def inline(svg: str, prefix: str, alternative: str) -> str:
    """Return an SVG document as part of a page.

    Its names get a prefix, so that they differ from those of other figures; its colours become
    variables of the page, and so does its type; its ground becomes the page's.
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
        f'<svg role="img" aria-label="{_escaped(alternative)}" viewBox="0 0 {width} {height}" '
        f'xmlns:xlink="http://www.w3.org/1999/xlink" style="{largest}">'
    )
    return head + body[body.index(">") + 1 :]


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
