"""Shared parts of pages: formatted numbers, colours, and inline drawings."""

import math
import re

import pytest
from matplotlib.figure import Figure

from fleet_slip.pages.page import (
    PALETTE,
    Picture,
    colour,
    degrees,
    draw,
    inline,
    join_words,
    number,
    percent,
    rich_text,
    scientific,
)


def test_numbers_read_well() -> None:
    assert number(-0.12345) == "−0.123"
    assert number(None) == "–"
    assert degrees(0.5, 1, sign=True) == "+0.5°"
    assert percent(0.999, 1) == "99.9 %"
    assert scientific(8.561e-4, 2) == "8.56 × 10⁻⁴"
    assert scientific(-0.0421, 2) == "−0.0421"
    assert join_words(["a", "b", "c"]) == "a, b and c"


def _luminance(hexadecimal: str) -> float:
    channels = [int(hexadecimal[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def _contrast(first: str, second: str) -> float:
    low, high = sorted((_luminance(first), _luminance(second)))
    return (high + 0.05) / (low + 0.05)


MODELS = tuple(f"model_{n}" for n in range(1, 6))
WRITTEN_IN = ("ink", "muted", "truth", "unstable", "kalman", "kalman_tuned", *MODELS)


@pytest.mark.parametrize("name", WRITTEN_IN)
def test_text_is_legible_on_light_and_dark_pages(name: str) -> None:
    """WCAG 2.2, success criterion 1.4.3: a contrast of at least 4.5."""
    ground, tone = PALETTE["surface"], PALETTE[name]
    assert _contrast(tone.light, ground.light) >= 4.5
    assert _contrast(tone.dark, ground.dark) >= 4.5


def test_no_two_colours_are_the_same() -> None:
    lights = [tone.light for tone in PALETTE.values()]
    assert len(set(lights)) == len(lights)


def _draw() -> Figure:
    figure = Figure(figsize=(10, 2))
    axes = figure.add_subplot()
    axes.plot([0, 1, 2], [0, 1, math.pi], color=colour("model_4"))
    axes.set_title("a <b> & c", color=colour("muted"))
    return figure


def test_a_drawing_on_the_page_takes_its_colours_from_the_page() -> None:
    picture = Picture("key", "title", "caption", 'says "x" & <y>', _draw)
    svg = draw(picture).svg
    assert "var(--model-4)" in svg
    assert not [tone.light for tone in PALETTE.values() if tone.light in svg]
    assert "<style" not in svg
    assert 'aria-label="title. says &#34;x&#34; &amp; &lt;y&gt; caption"' in svg
    names = re.findall(r'\bid="([^"]+)"', svg)
    assert names
    assert all(name.startswith("key-") for name in names)


def test_references_follow_their_names() -> None:
    svg = (
        '<?xml version="1.0"?><svg viewBox="0 0 72 36"><defs><clipPath id="p1"/></defs>'
        '<use xlink:href="#p1"/><g clip-path="url(#p1)"/></svg>'
    )
    inlined = inline(svg, "one", "text")
    assert 'id="one-p1"' in inlined
    assert 'href="#one-p1"' in inlined
    assert "url(#one-p1)" in inlined
    assert "max-width: 96px" in inlined


def test_texts_of_a_page_are_escaped_with_code_and_links() -> None:
    present = {"figure-1a", "table-2"}
    assert rich_text("III.A, Figure 1", present) == 'III.A, <a href="#figure-1a">Figure 1</a>'
    assert rich_text("Table II and Table I", present) == (
        '<a href="#table-2">Table II</a> and Table I'
    )
    assert rich_text("`a < b` <i>", present) == "<code>a &lt; b</code> &lt;i&gt;"
