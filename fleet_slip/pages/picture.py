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
        caption: what it tells, in numbers.
        seen: what is drawn, for those who cannot see it.
        draw: makes it at a size.
    """

    key: str
    title: str
    caption: str
    seen: str
    draw: Callable[[Size], Figure]

    @property
    def alternative(self) -> str:
        """The text in place of the figure."""
        return f"{self.title}. {self.seen} {self.caption}"
