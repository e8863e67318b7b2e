"""Keeps the rows of drives that have not ended yet."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from fleet_slip.arrays import FloatArray

MAX_OPEN_ROWS = 20_000_000
"""Rows of drives that have not ended: 55 hours at 100 Hz of drives that alternate row by row."""
MOST_RUNS = 8
"""Runs of one part in a block that are told apart one by one."""


@dataclass(frozen=True)
class DriveRows:
    """The rows of one drive, in the pieces that they came in: they are not joined without need."""

    pieces: Sequence[pl.DataFrame]

    @cached_property
    def height(self) -> int:
        """Number of rows."""
        return sum(piece.height for piece in self.pieces)

    @cached_property
    def group(self) -> int:
        """Number of what the rows say of the drive."""
        return int(self.pieces[0]["group"][0])

    @cached_property
    def time_s(self) -> FloatArray:
        """Times of all rows."""
        return self.column("time")

    def chunks(self, name: str) -> list[FloatArray]:
        """Return a column piece by piece, NaN where it has no value."""
        return [chunk.to_numpy() for piece in self.pieces for chunk in piece[name].get_chunks()]

    def column(self, name: str) -> FloatArray:
        """Return a column, NaN where it has no value."""
        chunks = self.chunks(name)
        return chunks[0] if len(chunks) == 1 else np.concatenate(chunks)

    def nulls(self, name: str) -> int:
        """Return how many rows have no value in a column."""
        return sum(piece[name].null_count() for piece in self.pieces)

    def frame(self) -> pl.DataFrame:
        """Return all rows in one frame."""
        return pl.concat(self.pieces)


class OpenDrives:
    """Rows by part, as long as the part has not ended."""

    def __init__(self) -> None:
        """Begin without rows."""
        self._rows: dict[int, list[pl.DataFrame]] = {}
        self.number_of_rows = 0

    def add(self, rows: pl.DataFrame) -> None:
        """Keep rows that are sorted by group, and so the rows of each part stand together."""
        if rows.is_empty():
            return
        self.number_of_rows += rows.height
        part = rows["part"].to_numpy()
        heads = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), rows.height]
        if len(heads) > MOST_RUNS + 1:
            runs = rows.partition_by("part", maintain_order=True)
        else:
            runs = [_run(rows, *ends) for ends in itertools.pairwise(heads)]
        for run in runs:
            self._rows.setdefault(int(run["part"][0]), []).append(run)

    def take(self, parts: Iterable[int]) -> Iterator[DriveRows]:
        """Yield the rows of parts that have any, and let go of them."""
        for part in parts:
            found = self._rows.pop(part, None)
            if found is not None:
                rows = DriveRows(found)
                self.number_of_rows -= rows.height
                yield rows


def _run(rows: pl.DataFrame, start: int, end: int) -> pl.DataFrame:
    """Return some rows; a copy if they are few, or they would keep all others in memory."""
    run = rows.slice(start, end - start)
    if 2 * run.height >= rows.height:
        return run
    return run.select(pl.all().gather(pl.int_range(pl.len())))
