"""Errors on a logarithmic axis: its ticks, and the name of each line at its right end."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fleet_slip.pages.style import POINTS_PER_INCH, Size, colour

LINE_POINTS = 13.0
"""Height of a line of text."""

HEIGHT_IN = 3.6
TICKS_DEG = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10)


@dataclass(frozen=True)
class End:
    """The right end of a line: its value, name and colour."""

    value: float
    label: str
    colour: str


def error_axes(
    size: Size, height_in: float = HEIGHT_IN, room_in: tuple[float, float] = (1.5, 1.05)
) -> Axes:
    """Return axes for errors, with room for names at the right: on wide and on narrow pages."""
    figure = Figure(figsize=(size.width_in, height_in))
    room = room_in[0] if size.wide else room_in[1]
    width = 1 - (0.5 + room) / size.width_in
    return figure.add_axes((0.5 / size.width_in, 0.45 / height_in, width, 1 - 0.8 / height_in))


def finish_errors(axes: Axes, label: str, ends: Sequence[End], size: Size) -> Figure:
    """Make the errors' axis logarithmic, and name axes and lines; return the figure."""
    axes.set_yscale("log")
    tick_degrees(axes)
    axes.set_xlabel(label, labelpad=2)
    axes.set_title("root mean square error", color=colour("muted"))
    label_ends(axes, ends, size)
    return cast(Figure, axes.figure)


def tick_degrees(axes: Axes) -> None:
    """Mark round angles on the logarithmic vertical axis."""
    low, high = axes.get_ylim()
    shown = [tick for tick in TICKS_DEG if low <= tick <= high]
    axes.set_yticks(shown, [f"{tick:g}°" for tick in shown])
    axes.minorticks_off()


def label_ends(axes: Axes, ends: Sequence[End], size: Size) -> None:
    """Write each line's name at its right end, on a logarithmic axis, apart to be read."""
    low, high = np.log(axes.get_ylim())
    pixels = axes.get_window_extent().height
    least = LINE_POINTS / (pixels * POINTS_PER_INCH / axes.figure.dpi)
    ordered = sorted(ends, key=lambda end: end.value)
    places = apart([(np.log(end.value) - low) / (high - low) for end in ordered], least)
    for place, end in zip(places, ordered, strict=True):
        axes.text(
            1.01,
            place,
            end.label,
            transform=axes.transAxes,
            color=colour(end.colour),
            va="center",
            fontsize=9 if size.wide else 8,
        )


def apart(places: Sequence[float], least: float) -> list[float]:
    """Move ascending places at most 1 apart by at least so much, up first, then down from 1."""
    moved = list(places)
    for i in range(1, len(moved)):
        moved[i] = max(moved[i], moved[i - 1] + least)
    moved[-1] = min(moved[-1], 1.0)
    for i in reversed(range(len(moved) - 1)):
        moved[i] = min(moved[i], moved[i + 1] - least)
    return moved
