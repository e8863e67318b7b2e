"""Finds measured logs: files, those of a folder, and folders whose files are parts of one log."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import shown

SUFFIXES = (
    ".csv", ".csv.gz", ".csv.zst", ".parquet", ".pq", ".mf4", ".mdf", ".mat", ".h5", ".hdf5",
    ".blf", ".asc", ".log", ".trc", ".duckdb", ".ddb", ".mcap",
)  # fmt: skip


def find_logs(paths: Iterable[Path]) -> list[Path]:
    """Return files as they are given, and those in folders that have the suffix of a log, sorted.

    Hidden files and folders are passed over. Raises `InputError` for a folder without any.
    """
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        inside = sorted(_logs_below(path))
        if not inside:
            raise InputError(
                f"{shown(path)}: no file in this folder has the suffix of a log: "
                f"{', '.join(SUFFIXES)}."
            )
        found += inside
    return found


def parts_of(log: Path) -> list[Path]:
    """Return the files that one log is in: itself, or those of its folder. Raises `InputError`."""
    return find_logs([log])


def _logs_below(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if name.lower().endswith(SUFFIXES) and not name.startswith("."):
                yield Path(parent, name)
