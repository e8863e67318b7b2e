"""What columns over time buy: error by number of columns, and error without some of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.report.figures.labels import End, error_axes, finish_errors
from fleet_slip.comparison.report.findings.memory import Memory, Without
from fleet_slip.pages.style import Size, colour
from fleet_slip.pages.text import degrees

BAR_IN = 0.2
HEAD_IN = 0.34
FOOT_IN = 0.4
NAMES_IN = 1.75
ROOM_IN = 0.6


@dataclass(frozen=True)
class Series:
    """One line: RMSE in deg at each place, such as of models of 1, 2, ... columns, shape (places,).

    `mark_deg`, if there is one, is what it is compared with, and drawn dashed.
    """

    label: str
    colour: str
    rmse_deg: FloatArray
    mark_deg: float | None = None


def error_by_columns(lines: Sequence[Series], size: Size) -> Figure:
    """Draw each line over the number of columns."""
    most = max(len(line.rmse_deg) for line in lines)
    figure = error_over(np.arange(1.0, most + 1), "columns", lines, size)
    (axes,) = figure.axes
    axes.set_xlim(0.5, most + 0.5)
    step = 1 if most <= 12 else 4
    axes.set_xticks([1, *range(step, most + 1, step)] if step > 1 else range(1, most + 1))
    return figure


def error_over(places: FloatArray, label: str, lines: Sequence[Series], size: Size) -> Figure:
    """Draw each line over some places, shape (places,), on a logarithmic scale."""
    axes = error_axes(size)
    for line in lines:
        tone = colour(line.colour)
        axes.plot(
            places[: len(line.rmse_deg)],
            line.rmse_deg,
            color=tone,
            linewidth=1.6,
            marker="o",
            markersize=3,
        )
        if line.mark_deg is not None:
            axes.axhline(line.mark_deg, color=tone, linewidth=0.9, linestyle=(0, (5, 3)))
    return finish_errors(
        axes, label, [End(float(o.rmse_deg[-1]), o.label, o.colour) for o in lines], size
    )


def left_out(memory: Memory, size: Size) -> Figure:
    """Draw what the RMSE rises to without each column, and without each length of window."""
    panels = [("without the column", memory.columns), ("without the windows of", memory.windows)]
    panels = [(title, bars) for title, bars in panels if bars]
    heights = [len(bars) * BAR_IN + HEAD_IN + FOOT_IN for _, bars in panels]
    across = len(panels) if size.wide else 1
    height = max(heights) if size.wide else sum(heights)
    figure = Figure(figsize=(size.width_in, height))
    each_in, top = size.width_in / across, height
    for i, ((title, bars), tall) in enumerate(zip(panels, heights, strict=True)):
        left = i * each_in if size.wide else 0.0
        axes = figure.add_axes(
            (
                (left + NAMES_IN) / size.width_in,
                (top - tall + FOOT_IN) / height,
                (each_in - NAMES_IN - ROOM_IN) / size.width_in,
                (tall - HEAD_IN - FOOT_IN) / height,
            )
        )
        _bars(axes, title, bars, memory.rmse_deg)
        top -= 0.0 if size.wide else tall
    return figure


def _bars(axes: Axes, title: str, bars: Sequence[Without], whole_deg: float) -> None:
    places = np.arange(len(bars))
    rises = [bar.rmse_deg - whole_deg for bar in bars]
    axes.barh(places, rises, left=whole_deg, height=0.62, color=colour("model_4"), linewidth=0)
    axes.axvline(whole_deg, color=colour("ink"), linewidth=0.9)
    axes.set_yticks(places, [_name(bar) for bar in bars], color=colour("ink"))
    axes.invert_yaxis()
    axes.set_ylim(len(bars) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.grid(visible=True, axis="x")
    axes.locator_params(axis="x", nbins=4)
    for place, bar in zip(places, bars, strict=True):
        axes.annotate(
            degrees(bar.rmse_deg, 4),
            (max(bar.rmse_deg, whole_deg), place),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=colour("muted"),
        )
    axes.set_title(title, color=colour("muted"))
    axes.set_xlabel("cross-validated RMSE (deg)", labelpad=2)


def _name(bar: Without) -> str:
    return bar.name if bar.columns == 1 else f"{bar.name} ({bar.columns} columns)"
