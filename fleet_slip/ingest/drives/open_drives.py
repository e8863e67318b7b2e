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
"""Runs of rows of one part, in a block, up to which they are sliced one by one."""


@dataclass(frozen=True)
class DriveRows:
    """The rows of one drive, in the pieces that they came in: they are not joined without need.

    Of several time bases, each piece is of one, and has the signals of that base only.
    """

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
    def start_s(self) -> float:
        """The first time."""
        return min(float(piece["time"][0]) for piece in self.pieces)

    @cached_property
    def end_s(self) -> float:
        """The last time."""
        return max(float(piece["time"][-1]) for piece in self.pieces)

    @cached_property
    def bases(self) -> tuple[int, ...]:
        """Numbers of the time bases; none if the file has but one."""
        return tuple(sorted({_base(piece) for piece in self.pieces if "base" in piece.columns}))

    @cached_property
    def time_s(self) -> FloatArray:
        """Times of all rows, which are of one base."""
        return self.column("time")

    def times_of(self, base: int) -> FloatArray:
        """Return the times of one of several bases."""
        return np.concatenate([p["time"].to_numpy() for p in self.pieces if _base(p) == base])

    def chunks(self, name: str) -> list[FloatArray]:
        """Return a column piece by piece, NaN where it has no value."""
        found: list[FloatArray] = []
        for piece in self.pieces:
            some = name in piece.columns
            chunks = (
                piece[name].get_chunks() if some else [pl.repeat(np.nan, piece.height, eager=True)]
            )
            found += [chunk.to_numpy() for chunk in chunks]
        return found

    def column(self, name: str) -> FloatArray:
        """Return a column, NaN where it has no value."""
        chunks = self.chunks(name)
        return chunks[0] if len(chunks) == 1 else np.concatenate(chunks)

    def samples(self, name: str) -> pl.DataFrame:
        """Return `time`, `base` and a signal where it has a value, by time, of several bases."""
        columns = ["time", "base", name]
        some = [piece.select(columns) for piece in self.pieces if name in piece.columns]
        if not some:
            return pl.DataFrame(schema=dict.fromkeys(columns, pl.Float64))
        found = pl.concat(some).filter(pl.col(name).is_not_null())
        return found if found["time"].is_sorted() else found.sort("time", maintain_order=True)

    def number_of(self, name: str) -> int:
        """Return how many rows have a value in a column."""
        columns = [piece[name] for piece in self.pieces if name in piece.columns]
        return sum(len(column) - column.null_count() for column in columns)

    def frame(self) -> pl.DataFrame:
        """Return all rows in one frame."""
        return pl.concat(self.pieces, how="diagonal")


def _base(piece: pl.DataFrame) -> int:
    return int(piece["base"][0])


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
            pieces = _by_base(run) if "base" in run.columns else [run]
            self._rows.setdefault(int(run["part"][0]), []).extend(pieces)

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


def _by_base(run: pl.DataFrame) -> list[pl.DataFrame]:
    """Return the rows of each time base, with those columns that have a value there."""
    bases = run.drop("part").partition_by("base", maintain_order=True)
    return [
        rows.select(column for column in rows if column.null_count() < rows.height)
        for rows in bases
    ]
