"""Predicted against true side-slip angles of the training drives, each predicted when held out."""

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from fleet_slip.comparison.report.findings.histogram import Histogram
from fleet_slip.pages.style import Size, colour

SIDE_IN = 4.6
FAINTEST = 0.12
SHARE_SHOWN = 0.9999


def density(histogram: Histogram, size: Size) -> Figure:
    """Draw how many rows fall into each cell, darker for more, on a logarithmic scale."""
    side = min(SIDE_IN, size.width_in - 0.7)
    height = side + 0.95
    figure = Figure(figsize=(side + 0.7, height))
    width = side + 0.7
    axes = figure.add_axes((0.52 / width, 0.45 / height, side / width, side / height))
    reach = histogram.reach_deg(SHARE_SHOWN)
    cells = histogram.cells(reach)
    shade = np.zeros_like(cells, dtype=np.float64)
    filled = cells > 0
    shade[filled] = FAINTEST + (1 - FAINTEST) * np.log1p(cells[filled]) / np.log1p(cells.max())
    image = np.empty((*cells.shape, 4))
    image[..., :3] = to_rgb(colour("model_5"))
    image[..., 3] = shade
    axes.imshow(
        image,
        origin="lower",
        extent=(-reach, reach, -reach, reach),
        interpolation="nearest",
        zorder=2,
    )
    axes.axline((0, 0), slope=1, color=colour("muted"), linewidth=0.8, zorder=3)
    axes.grid(visible=True, axis="both")
    axes.set_xlabel("true (deg)", labelpad=2)
    axes.set_ylabel("predicted (deg)", labelpad=2)
    _key(figure, int(cells.max()))
    return figure


def _key(figure: Figure, most: int) -> None:
    """Draw the scale: from one row in a cell to the most."""
    width, height = figure.get_size_inches()
    axes = figure.add_axes((0.52 / width, 1 - 0.27 / height, 1.6 / width, 0.12 / height))
    ramp = np.empty((1, 64, 4))
    ramp[..., :3] = to_rgb(colour("model_5"))
    ramp[..., 3] = np.linspace(FAINTEST, 1, 64)
    axes.imshow(ramp, aspect="auto", extent=(0, 1, 0, 1))
    axes.set_axis_off()
    figure.text(
        2.2 / width,
        1 - 0.15 / height,
        f"1 to {most:,} rows",
        va="top",
        fontsize=8.5,
        color=colour("muted"),
    )
