"""Keeps the rows of drives that have not ended yet."""

from collections.abc import Iterable, Iterator

import polars as pl

MAX_OPEN_ROWS = 20_000_000
"""Rows of drives that have not ended: 55 hours at 100 Hz of drives that alternate row by row."""


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
        if rows["part"][0] == rows["part"][-1] and rows["part"].n_unique() == 1:
            self._rows.setdefault(rows["part"][0], []).append(rows)
            return
        # What is partitioned is copied: rows of a drive that has ended are not held by others.
        for (part,), found in rows.partition_by("part", as_dict=True, maintain_order=True).items():
            self._rows.setdefault(int(part), []).append(found)

    def take(self, parts: Iterable[int]) -> Iterator[pl.DataFrame]:
        """Yield the rows of parts that have any, and let go of them."""
        for part in parts:
            found = self._rows.pop(part, None)
            if found is not None:
                rows = pl.concat(found)
                self.number_of_rows -= rows.height
                yield rows
