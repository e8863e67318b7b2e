"""Finds measured logs: files, and those of a folder or a pattern.

They are on this machine, or on an object store. Every format is read where it can be sought in and
mapped, so that a log on a store is copied as a whole to the temporary folder (`TMPDIR`).
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cache
from glob import glob
from pathlib import Path, PosixPath
from tempfile import TemporaryDirectory
from typing import TypeAlias

from fleet_slip.base import needed, shown
from fleet_slip.errors import FleetSlipError, InputError
from fleet_slip.storage.folder import StoredFile
from fleet_slip.storage.storage_errors import storage_errors

SUFFIXES = (
    ".csv", ".csv.gz", ".csv.zst", ".parquet", ".pq", ".mf4", ".mdf", ".mat", ".h5", ".hdf5",
    ".blf", ".asc", ".log", ".trc", ".mcap", ".tdms", ".vbo",
)  # fmt: skip

_HIDDEN = re.compile(r"/\.(?!\.?(/|$))")
"""A part of a path that begins with a point, and is not `.` or `..`: those are faults."""

WILDCARDS = frozenset("*?[")

_NO_LOG = f"no file in this folder has the suffix of a log: {', '.join(SUFFIXES)}."

AT_ONCE = 16

LONGEST_NAME_BYTES = 255

_CONTROL = re.compile(r"[\x00-\x1f\x7f]")


class StrayLink(PosixPath):
    """A file found behind a link out of a folder: who fills it may not choose what is read."""


Log: TypeAlias = Path | StoredFile
"""A measured log: a file, here or on an object store."""

OpenCopy: TypeAlias = Callable[[Log], AbstractContextManager[Path]]

Place: TypeAlias = Path | str
"""What a person gives: a path, a pattern, or the URL of an object store."""


def find_logs(given: Iterable[Place]) -> list[Log]:
    """Return files as they are given, and those in folders that have the suffix of a log, sorted.

    What is not a path may be a pattern such as `2024-*/*.mf4`, given in quotes. Hidden files and
    folders are passed over. Raises `InputError` for a folder or a pattern without any.
    """
    found: list[Log] = []
    for place in given:
        if is_url(place):
            found += _stored(str(place))
        else:
            found += find_files(Path(place))
    return found


def find_files(path: Path) -> list[Path]:
    """Return a file of this machine, or those that a folder or a pattern stands for."""
    if is_pattern(path):
        return _matching(path)
    if not path.is_dir():
        return [path]
    real = path.resolve()
    tables = [path / "logs", *(one for one in (real, *real.parents) if one.name == "logs")]
    _require_no_root(path, any((table / "_delta_log").is_dir() for table in tables))
    inside = sorted(_logs_below(path))
    if not inside:
        raise InputError(f"{shown(path)}: {_NO_LOG}")
    return _without_strays(inside, path)


def _require_no_root(place: Place, is_root: bool) -> None:
    """Raise `InputError` for a data root: what is in it is in it."""
    if is_root:
        raise InputError(
            f"{shown(place)}: part of a data root, whose logs are stored already. Name the folder "
            "of your logs."
        )


def names_several(place: Place) -> bool:
    """Whether it is a folder or a pattern, of which what is new is taken."""
    if is_url(place):
        return not str(place).lower().endswith(SUFFIXES) or is_pattern(str(place))
    return Path(place).is_dir() or is_pattern(Path(place))


def is_url(place: Place) -> bool:
    """Whether a place is on an object store."""
    return isinstance(place, str) and "://" in place


def is_pattern(place: Place) -> bool:
    """Whether a path stands for those that match it."""
    return bool(WILDCARDS.intersection(str(place))) and (is_url(place) or not Path(place).exists())


def _stored(url: str) -> list[StoredFile]:
    with needed("objects", "a log on an object store"):
        from fleet_slip.ingest.object_inputs import find_below, find_object  # noqa: PLC0415
    if (one := find_object(url)) is not None:
        return [one]
    below = find_below(url)
    _require_no_root(url, any("/logs/_delta_log/" in f"/{file.path}" for file in below))
    seen = [file for file in below if not _HIDDEN.search(str(file)) or "/." in url]
    if is_pattern(url):
        found, none = seen, "no object matches this pattern. Look at its folder."
    else:
        found = [file for file in seen if file.name.lower().endswith(SUFFIXES)]
        none = _NO_LOG if below else "no such object, and no folder."
    if not found:
        raise InputError(f"{shown(url)}: {none}")
    return found


def _matching(pattern: Path) -> list[Path]:
    names = sorted(glob(str(pattern), recursive=True))  # noqa: PTH207 - takes absolute ones
    files = [path for path in map(Path, names) if path.is_file()]
    if not files:
        raise InputError(f"{shown(pattern)}: no file matches this pattern. Look at its folder.")
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


@contextmanager
def local_copies(logs: Iterable[Log]) -> Iterator[OpenCopy]:
    """Fetch the logs that are on a store, at once; give what opens each of all."""
    stored = [log for log in dict.fromkeys(logs) if not isinstance(log, Path)]
    with ExitStack() as stack:
        folders, copies = dict[Log, Path](), dict[Log, Future[Path]]()
        if stored:
            with storage_errors("the temporary folder"):
                top = stack.enter_context(TemporaryDirectory(prefix="fleet-slip-copies-"))
            threads = ThreadPoolExecutor(AT_ONCE)
            stack.callback(threads.shutdown, cancel_futures=True)
            folders = {log: Path(top, str(number)) for number, log in enumerate(stored)}
            copies = {log: threads.submit(_copy, log, folders[log]) for log in stored}

        @contextmanager
        def open_copy(log: Log) -> Iterator[Path]:
            """Give the file to read a log from, whose errors name the log. Raises `InputError`."""
            if isinstance(log, StrayLink):
                raise InputError(
                    f"{shown(log)}: a symbolic link out of its folder, not followed. Give the file "
                    "by its own path."
                )
            if isinstance(log, Path):
                yield log
                return
            copy = copies[log].result()
            try:
                yield copy
            except FleetSlipError as error:
                bucket = "/".join(str(log).split("/")[:3])
                raise type(error)(str(error).replace(str(folders[log]), bucket)) from None

        yield open_copy


def _copy(log: StoredFile, folder: Path) -> Path:
    """Copy a log below a folder, under its path in the bucket: keys may be in its names."""
    from fleet_slip.ingest.object_inputs import copy_object  # noqa: PLC0415 - an extra

    names = log.path.split("/")
    odd = {"", ".", ".."}.intersection(names) or _CONTROL.search(log.path)
    if odd or max(len(os.fsencode(name)) for name in names) > LONGEST_NAME_BYTES:
        raise InputError(f"{shown(log)}: invalid file name. Rename it.")
    copy_object(log, folder / log.path)
    return folder / log.path


@contextmanager
def local_copy(log: Log) -> Iterator[Path]:
    """Give the file to read one log from. Raises what opening it raises."""
    with local_copies([log]) as open_copy, open_copy(log) as file:
        yield file
