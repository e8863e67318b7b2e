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
"""Values of drives that have not ended, in memory; all others wait in a temporary file."""
MAX_PARTS_AT_ONCE = 64
"""Parts whose rows are taken out of a block at once: thousands of small frames take much memory."""
MAX_SINGLE_PIECES, BUNDLED_GROUPS = 512, 128
"""Maximum number of parts that are spilled one by one; beyond it groups are bundled."""


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
    """Rows by part, as long as the part has not ended, few of them in memory.

    Where hundreds of parts are open at once, their rows are put aside by bundles of groups, and
    no part is yielded before the last.
    """

    def __init__(self) -> None:
        """Begin without rows."""
        self._blocks: list[pl.DataFrame] = []
        self._in_memory = 0
        self._spool = Spool()
        self._bundled = False
        self._ended: list[int] = []
        self._group_of: dict[int, int] = {}
        """The group of each part with spilled rows."""

    def add(self, rows: pl.DataFrame) -> None:
        """Keep rows with their part."""
        if rows.height:
            self._blocks.append(rows)
            self._in_memory += rows.height * rows.width

    def take(self, parts: Sequence[int], *, last: bool) -> Iterator[DriveRows]:
        """Yield the rows of parts that have any, and let go of them; the last are all."""
        if not self._bundled:
            yield from self._take(parts)
            return
        self._ended += parts
        if last:
            yield from self._unbundled()

    def _take(self, parts: Sequence[int]) -> Iterator[DriveRows]:
        for start in range(0, len(parts), MAX_PARTS_AT_ONCE):
            chunk = parts[start : start + MAX_PARTS_AT_ONCE]
            rows_in_memory = self._let_go(chunk)
            for part in chunk:
                self._group_of.pop(part, None)
                put_aside = map(pl.read_ipc_stream, self._spool.take(part))
                if pieces := [*put_aside, *rows_in_memory[part]]:
                    yield DriveRows(_by_base(pieces))

    def _let_go(self, parts: Sequence[int]) -> dict[int, list[pl.DataFrame]]:
        """Take the rows of parts out of memory."""
        rows_of_part = defaultdict[int, list[pl.DataFrame]](list)
        is_taken = pl.col("part").is_in(parts)
        for _ in range(len(self._blocks)):
            rows = self._blocks.pop(0)
            for run in rows.filter(is_taken).partition_by("part", maintain_order=True):
                rows_of_part[run["part"][0]].append(run)
            self._in_memory -= rows.height * rows.width
            self.add(rows.filter(~is_taken))
        return rows_of_part

    def _unbundled(self) -> Iterator[DriveRows]:
        """Yield the rows of all parts, bundle by bundle, and in each as the parts ended."""
        self._put_aside(bundled=True)
        bundles = defaultdict[int, list[int]](list)
        for part in self._ended:
            bundles[self._group_of.get(part, 0) // BUNDLED_GROUPS].append(part)
        for bundle, parts in sorted(bundles.items()):
            for piece in self._spool.take(("bundle", bundle)):
                self.add(pl.read_ipc_stream(piece))
                if self._in_memory > MAX_OPEN_VALUES:
                    self._put_aside(bundled=False)
            if self._blocks:  # hundreds of small frames a part would take much memory
                self._blocks = [pl.concat(self._blocks, rechunk=True)]
            yield from self._take(parts)

    def spill(self) -> None:
        """Put the rows aside if they are many. Raises `InputError` if the disk is full."""
        if self._in_memory > MAX_OPEN_VALUES:
            parts = pl.concat([rows["part"] for rows in self._blocks]).n_unique()
            self._bundled |= parts > MAX_SINGLE_PIECES
            self._put_aside(bundled=self._bundled)

    def _put_aside(self, *, bundled: bool) -> None:
        """Put all rows aside, by bundles or by parts."""
        if not self._blocks:
            return
        rows = pl.concat(self._blocks)
        self._blocks, self._in_memory = [], 0
        heads = rows.select("part", "group").unique("part")
        self._group_of.update(zip(heads["part"], heads["group"], strict=True))
        key = (pl.col("group") // BUNDLED_GROUPS if bundled else pl.col("part")).alias("key")
        pieces = rows.with_columns(key).partition_by("key", as_dict=True, include_key=False)
        for (number,), piece in pieces.items():
            content = BytesIO()
            piece.write_ipc_stream(content, compression="lz4")
            self._spool.add(("bundle", number) if bundled else number, content.getvalue())


def _by_base(pieces: list[pl.DataFrame]) -> dict[int, pl.DataFrame]:
    """Return the rows of each time base, with those columns that have a value there."""
    if "base" not in pieces[0].columns:
        return {0: pl.concat(pieces)}
    bases = defaultdict[int, list[pl.DataFrame]](list)
    for piece in pieces:
        for rows in piece.drop("part").partition_by("base", maintain_order=True):
            filled = rows.select(column for column in rows if column.null_count() < rows.height)
            bases[rows["base"][0]].append(filled)
    return {base: pl.concat(bases[base], how="diagonal") for base in sorted(bases)}
