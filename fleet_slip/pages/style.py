"""The look of the figures: colours, type and lines, for light and for dark pages.

Figures are drawn once, in the light colours. On the page every colour of the palette becomes a CSS
variable, so that the same drawing follows the reader's preference.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

POINTS_PER_INCH = 72.0
POINTS_PER_BIN = 1.5


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
    "outage": Colour("#8a8f98", "#7d8590"),
    "below_3": Colour("#08519c", "#6baeff"),
    "below_2": Colour("#3d85c6", "#4f8fd8"),
    "below_1": Colour("#9dbfe0", "#3d5f85"),
    "near_0": Colour("#c9cdd2", "#565d66"),
    "above_1": Colour("#f2b183", "#855637"),
    "above_2": Colour("#de7426", "#d97f3a"),
    "above_3": Colour("#8c3500", "#ffae70"),
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
    """Return a colour of the palette as figures are drawn with it."""
    return PALETTE[name].light


@dataclass(frozen=True)
class Size:
    """What a figure is drawn for: its width, and whether panels fit side by side."""

    width_in: float
    wide: bool

    @property
    def bins(self) -> int:
        """Number of bins that a series over the whole width is cut into."""
        return int(self.width_in * POINTS_PER_INCH / POINTS_PER_BIN)


DESK = Size(10.4, wide=True)
"""At a scale of 1 the text of a figure is as large as small print on the page."""

PHONE = Size(3.75, wide=False)
