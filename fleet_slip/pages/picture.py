"""What a figure of the report is: words, and a drawing at a size."""

from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.figure import Figure

from fleet_slip.pages.style import Size


@dataclass(frozen=True)
class Picture:
    """One figure of the report.

    Attributes:
        key: name of its files, and of its place on the page.
        title: what it shows.
        caption: what is to be seen, in numbers.
        alternative: for those who cannot see it.
        draw: makes it at a size.
    """

    key: str
    title: str
    caption: str
    alternative: str
    draw: Callable[[Size], Figure]
