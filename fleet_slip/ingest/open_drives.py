"""Collects the rows of drives until they end, few of them in memory."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO

import numpy as np
import polars as pl

from fleet_slip.ingest.formats.source import Spool

MAX_OPEN_VALUES = 2**21
"""Maximum values of open drives in memory; the others are in a temporary file."""
MAX_SEGMENTS_AT_ONCE = 64
"""Segments taken out of blocks at once: thousands of small frames take much memory."""
MAX_SINGLE_PIECES, BUNDLED_GROUPS = 512, 128
"""Maximum number of segments that are spilled one by one; beyond it groups are bundled."""


@dataclass(frozen=True)
class DriveRows:
    """The rows of one drive by time base, in chunks that are not copied together.

    Each of several bases has the signals with values in it.
    """

    bases: dict[int, pl.DataFrame]

    @cached_property
    def height(self) -> int:
        """Number of rows."""
        return sum(rows.height for rows in self.bases.values())

    @cached_property
    def start_s(self) -> float:
        """The first time."""
        return min(float(rows["time"][0]) for rows in self.bases.values())

    @cached_property
    def end_s(self) -> float:
        """The last time."""
        return max(float(rows["time"][-1]) for rows in self.bases.values())

    @cached_property
    def frame(self) -> pl.DataFrame:
        """All rows in one frame."""
        return pl.concat(self.bases.values(), how="diagonal")

    def column(self, name: str) -> pl.Series:
        """Return a column of the only base."""
        (rows,) = self.bases.values()
        return rows[name] if name in rows.columns else pl.repeat(np.nan, rows.height, eager=True)

    def samples(self, name: str) -> pl.DataFrame:
        """Return `time` and a signal where it has a value, by time."""
        frames = [rows.select("time", name) for rows in self.bases.values() if name in rows.columns]
        if not frames:
            return pl.DataFrame(schema={"time": pl.Float64, name: pl.Float64})
        samples = pl.concat(frames).drop_nulls(name)
        return samples if samples["time"].is_sorted() else samples.sort("time", maintain_order=True)


class OpenDrives:
    """The rows of open segments, few of them in memory.

    If hundreds of segments are open at once, their rows are spilled in bundles of groups, and no
    segment is yielded before the end of the file.
    """

    def __init__(self) -> None:
        """Begin without rows."""
        self._blocks: list[pl.DataFrame] = []
        self._in_memory = 0
        self._spool = Spool()
        self._bundled = False
        self._ended: list[int] = []
        self._group_of: dict[int, int] = {}
        """The group of each segment with spilled rows."""

    def add(self, rows: pl.DataFrame) -> None:
        """Keep rows with their segment."""
        if rows.height:
            self._blocks.append(rows)
            self._in_memory += rows.height * rows.width

    def take(self, segments: Sequence[int], *, last: bool) -> Iterator[DriveRows]:
        """Yield the rows of segments and release them; `last` for the end of the file."""
        if not self._bundled:
            yield from self._take(segments)
            return
        self._ended += segments
        if last:
            yield from self._unbundled()

    def _take(self, segments: Sequence[int]) -> Iterator[DriveRows]:
        for start in range(0, len(segments), MAX_SEGMENTS_AT_ONCE):
            chunk = segments[start : start + MAX_SEGMENTS_AT_ONCE]
            rows_in_memory = self._release(chunk)
            for segment in chunk:
                self._group_of.pop(segment, None)
                spilled = map(pl.read_ipc_stream, self._spool.take(segment))
                if pieces := [*spilled, *rows_in_memory[segment]]:
                    yield DriveRows(_by_base(pieces))

    def _release(self, segments: Sequence[int]) -> dict[int, list[pl.DataFrame]]:
        """Take the rows of segments out of memory."""
        rows_of_segment = defaultdict[int, list[pl.DataFrame]](list)
        is_taken = pl.col("segment").is_in(segments)
        for _ in range(len(self._blocks)):
            rows = self._blocks.pop(0)
            for run in rows.filter(is_taken).partition_by("segment", maintain_order=True):
                rows_of_segment[run["segment"][0]].append(run)
            self._in_memory -= rows.height * rows.width
            self.add(rows.filter(~is_taken))
        return rows_of_segment

    def _unbundled(self) -> Iterator[DriveRows]:
        """Yield the rows of all segments, bundle by bundle, and in each as the segments ended."""
        self._spill_rows(bundled=True)
        bundles = defaultdict[int, list[int]](list)
        for segment in self._ended:
            bundles[self._group_of.get(segment, 0) // BUNDLED_GROUPS].append(segment)
        for bundle, segments in sorted(bundles.items()):
            for piece in self._spool.take(("bundle", bundle)):
                self.add(pl.read_ipc_stream(piece))
                if self._in_memory > MAX_OPEN_VALUES:
                    self._spill_rows(bundled=False)
            if self._blocks:  # hundreds of small frames a segment would take much memory
                self._blocks = [pl.concat(self._blocks, rechunk=True)]
            yield from self._take(segments)

    def spill(self) -> None:
        """Spill the rows if they are many. Raises `InputError` if the disk is full."""
        if self._in_memory > MAX_OPEN_VALUES:
            segments = pl.concat([rows["segment"] for rows in self._blocks]).n_unique()
            self._bundled |= segments > MAX_SINGLE_PIECES
            self._spill_rows(bundled=self._bundled)

    def _spill_rows(self, *, bundled: bool) -> None:
        """Spill all rows, by bundles or by segments."""
        if not self._blocks:
            return
        rows = pl.concat(self._blocks)
        self._blocks, self._in_memory = [], 0
        heads = rows.select("segment", "group").unique("segment")
        self._group_of.update(zip(heads["segment"], heads["group"], strict=True))
        key = (pl.col("group") // BUNDLED_GROUPS if bundled else pl.col("segment")).alias("key")
        pieces = rows.with_columns(key).partition_by("key", as_dict=True, include_key=False)
        for (number,), piece in pieces.items():
            content = BytesIO()
            piece.write_ipc_stream(content, compression="lz4")
            self._spool.add(("bundle", number) if bundled else number, content.getvalue())


def _by_base(pieces: list[pl.DataFrame]) -> dict[int, pl.DataFrame]:
    """Return the rows of each time base, with the columns that have values in it."""
    if "base" not in pieces[0].columns:
        return {0: pl.concat(pieces)}
    bases = defaultdict[int, list[pl.DataFrame]](list)
    for piece in pieces:
        for rows in piece.drop("segment").partition_by("base", maintain_order=True):
            filled = rows.select(column for column in rows if column.null_count() < rows.height)
            bases[rows["base"][0]].append(filled)
    return {base: pl.concat(bases[base], how="diagonal") for base in sorted(bases)}
