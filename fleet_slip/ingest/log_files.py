"""Finds measured logs: files, those of a folder, and folders whose files are parts of one log."""

import os
from collections.abc import Iterable, Iterator
from glob import glob
from pathlib import Path

from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import shown

SUFFIXES = (
    ".csv", ".csv.gz", ".csv.zst", ".parquet", ".pq", ".mf4", ".mdf", ".mat", ".h5", ".hdf5",
    ".blf", ".asc", ".log", ".trc", ".duckdb", ".ddb", ".mcap",
)  # fmt: skip


def find_logs(paths: Iterable[Path]) -> list[Path]:
    """Return files as they are given, and those in folders that have the suffix of a log, sorted.

    A path that is none may be a pattern, `2024-*/*.mf4`, for who gives it in quotes. Hidden files
    and folders are passed over. Raises `InputError` for a folder or a pattern without any.
    """
    found: list[Path] = []
    for path in paths:
        if is_pattern(path):
            found += _matching(path)
            continue
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


def is_pattern(path: Path) -> bool:
    """Whether a path stands for those that match it."""
    return any(c in str(path) for c in "*?[") and not path.exists()


def _matching(pattern: Path) -> list[Path]:
    names = sorted(glob(str(pattern), recursive=True))  # noqa: PTH207 - takes absolute ones
    files = [path for path in map(Path, names) if path.is_file()]
    if not files:
        raise InputError(f"{shown(pattern)}: no file matches this pattern. Look at its folder.")
    return files


def parts_of(log: Path) -> list[Path]:
    """Return the files that one log is in: itself, or those of its folder. Raises `InputError`."""
    return find_logs([log])


def _logs_below(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if name.lower().endswith(SUFFIXES) and not name.startswith("."):
                yield Path(parent, name)
