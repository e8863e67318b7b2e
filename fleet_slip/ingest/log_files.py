"""Finds measured logs on this machine: files, and those of a folder or a pattern."""

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from glob import glob
from pathlib import Path, PosixPath

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError

SUFFIXES = (
    ".csv", ".csv.gz", ".csv.zst", ".parquet", ".pq", ".mf4", ".mdf", ".mat", ".h5", ".hdf5",
    ".blf", ".asc", ".log", ".trc", ".mcap", ".tdms", ".vbo",
)  # fmt: skip

WILDCARDS = frozenset("*?[")


class StrayLink(PosixPath):
    """A file behind a link out of its folder, which is refused."""


def find_logs(paths: Iterable[Path | str]) -> list[Path]:
    """Return the given files, and the logs in the given folders, sorted.

    A path that does not exist may be a pattern such as `2024-*/*.mf4`. The suffix identifies logs
    in folders; hidden files and folders are skipped. Raises `InputError` for no files.
    """
    for place in paths:
        if "://" in str(place):
            raise InputError(
                "logs are files of this machine. Copy those of an object store first, such as by: "
                "aws s3 sync URL FOLDER"
            )
    return [file for place in paths for file in _files_of(Path(place))]


def _files_of(path: Path) -> list[Path]:
    """Return the files of a path: itself, those of a folder, or those that match a pattern."""
    if is_pattern(path):
        return _matching(path)
    if not path.is_dir():
        return [path]
    real = path.resolve()
    tables = [path / "logs", *(parent for parent in (real, *real.parents) if parent.name == "logs")]
    if any((table / "_delta_log").is_dir() for table in tables):
        raise InputError(
            f"{quote_name(path)}: part of a data root, whose logs are stored already. Name the "
            "folder "
            "of your logs."
        )
    inside = sorted(_logs_below(path))
    if not inside:
        raise InputError(
            f"{quote_name(path)}: no file in this folder has the suffix of a log: "
            f"{', '.join(SUFFIXES)}."
        )
    return _without_strays(inside, path)


def names_several(place: Path | str) -> bool:
    """Return True for a folder or a pattern, of which only new files are ingested."""
    return Path(place).is_dir() or is_pattern(Path(place))


def is_pattern(path: Path) -> bool:
    """Return True if a path is a pattern."""
    return bool(WILDCARDS.intersection(str(path))) and not path.exists()


def _matching(pattern: Path) -> list[Path]:
    names = sorted(glob(str(pattern), recursive=True))  # noqa: PTH207 - takes absolute ones
    files = [path for path in map(Path, names) if path.is_file()]
    if not files:
        raise InputError(
            f"{quote_name(pattern)}: no file matches this pattern. Look at its folder."
        )
    plain = [part for part in pattern.parents if not WILDCARDS.intersection(str(part))]
    return _without_strays(files, plain[0])


def _without_strays(files: list[Path], folder: Path) -> list[Path]:
    """Return files that were found below a folder, marked where they are in truth elsewhere."""
    top = os.path.realpath(folder)
    real = cache(os.path.realpath)

    def is_inside(file: Path) -> bool:
        place = os.path.realpath(file) if file.is_symlink() else f"{real(file.parent)}/"
        return os.path.commonpath([top, place]) == top

    return [file if is_inside(file) else StrayLink(file) for file in files]


def _logs_below(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if name.lower().endswith(SUFFIXES) and not name.startswith("."):
                yield Path(parent, name)


def state_of(log: Path) -> tuple[int, int] | None:
    """Return size and time of change, None if the file cannot be examined."""
    with suppress(OSError):  # the reader of the file reports the problem
        status = log.stat()
        return status.st_size, status.st_mtime_ns
    return None


def size_of(log: Path) -> int:
    """Return the bytes of a log, 0 if it cannot be examined."""
    return (state_of(log) or (0, 0))[0]
