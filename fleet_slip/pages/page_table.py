"""A table of the report: cells, some of them marked."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Mark = Literal["", "good", "miss"]


@dataclass(frozen=True)
class Cell:
    """One cell: its text, and whether it is marked."""

    text: str
    mark: Mark = ""


@dataclass(frozen=True)
class ReportTable:
    """A table with a caption; the first `left` columns are text, the others are numbers."""

    key: str
    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    left: int = 1
    note: str = ""


def table(
    key: str,
    caption: str,
    head: Sequence[str],
    rows: Sequence[Sequence[str | Cell]],
    *,
    left: int = 1,
    note: str = "",
) -> ReportTable:
    """Return a table of plain texts and marked cells."""
    cells = [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in rows]
    return ReportTable(key, caption, head, cells, left, note)


@dataclass(frozen=True)
class Tile:
    """One number of a page's summary."""

    value: str
    label: str
