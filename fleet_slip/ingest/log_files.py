"""Finds measured logs on this machine: files, and those of a folder or a pattern."""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from glob import glob
from pathlib import Path

from fleet_slip.base import pluralize, quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.file_groups import FileGroup, group_lake
from fleet_slip.ingest.formats.reading import BEGINNINGS, SUFFIXES, StrayLink
from fleet_slip.ingest.mapping import FilePattern, Mapping

_COMPANIONS = (
    ".toml", ".dbc", ".kcd", ".sym", ".arxml", ".a2l", ".md", ".json", ".yaml", ".yml", ".pdf",
    ".png", ".jpg", ".py", ".sh", ".tdms_index",
)  # fmt: skip
"""Suffixes of files beside logs that are not logs."""

WILDCARDS = frozenset("*?[")


class LogFiles(list[Path]):
    """Logs, and the other files of their folders whose suffix is not that of a log."""

    def __init__(self, logs: Iterable[Path], passed_over: Iterable[Path]) -> None:
        """Take both."""
        super().__init__(logs)
        self.passed_over = tuple(passed_over)

    def describe_passed_over(self) -> str:
        """Return a sentence on the files that were passed over, empty without any."""
        if not self.passed_over:
            return ""
        names = ", ".join(quote_name(file) for file in self.passed_over[:3])
        more = " …" if len(self.passed_over) > 3 else ""
        files = pluralize(len(self.passed_over), "file")
        return (
            f"{files} passed over, without the suffix of a log: {names}{more}. Rename a log, or "
            "give its path."
        )


def find_logs(paths: Iterable[Path | str], mapping: Mapping | None = None) -> LogFiles:
    """Return the given files, and the logs in the given folders, sorted.

    A path that does not exist may be a pattern such as `2024-*/*.mf4`. The suffix identifies logs
    in folders, or the first bytes; hidden files and folders are skipped. Several files are
    one log, a `FileGroup`, in a lake of messages and by the patterns of a mapping. Raises
    `InputError` for no files.
    """
    places, passed_over = list(paths), list[Path]()
    for place in places:
        if "://" in str(place):
            raise InputError(
                "logs are files of this machine. Copy those of an object store first, such as by: "
                "aws s3 sync URL FOLDER"
            )
    files = [file for place in places for file in _files_of(Path(place), passed_over)]
    if mapping is not None and mapping.file:
        files = _group_by_patterns(files, mapping.file, passed_over)
    elif mapping is None or mapping.time.own_clock:
        files = group_lake(files)
    return LogFiles(files, sorted(passed_over))


def _group_by_patterns(
    files: Iterable[Path], patterns: Sequence[FilePattern], passed_over: list[Path]
) -> list[Path]:
    """Return a log for each drive with all files; pass over the others."""
    members: dict[Path, dict[str, tuple[Path, ...]]] = defaultdict(dict)
    for file in files:
        for pattern in patterns:
            if (match := pattern.find(file)) is not None:
                members[match[0] / match[1]][pattern.name] = (file,)
                break
        else:
            passed_over.append(file)
    return [
        FileGroup.create(path, files_of_drive) for path, files_of_drive in sorted(members.items())
    ]


def _files_of(path: Path, passed_over: list[Path]) -> list[Path]:
    """Return the files of a path: itself, those of a folder, or those that match a pattern.

    Adds other files of the folder to `passed_over`.
    """
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
    inside = sorted(_logs_below(path, passed_over))
    if not inside:
        raise InputError(
            f"{quote_name(path)}: no file in this folder has the suffix of a log: "
            f"{', '.join(SUFFIXES)}. {LogFiles([], passed_over).describe_passed_over()}".rstrip()
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

    return [
        file if isinstance(file, StrayLink) or is_inside(file) else StrayLink(file)
        for file in files
    ]


def _logs_below(folder: Path, passed_over: list[Path]) -> Iterator[Path]:
    top = os.path.realpath(folder)
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in folders:
            linked = Path(parent, name)
            if linked.is_symlink() and os.path.commonpath([top, os.path.realpath(linked)]) != top:
                yield StrayLink(linked)
        for name in names:
            file = Path(parent, name)
            if name.startswith(".") or name.lower().endswith(_COMPANIONS):
                continue
            if name.lower().endswith(SUFFIXES) or _begins_as_log(file):
                yield file
            else:
                passed_over.append(file)


def _begins_as_log(file: Path) -> bool:
    """Return True if the first bytes of a file are those of a log."""
    with suppress(OSError):
        if file.is_file():  # a pipe would be waited for
            with file.open("rb") as stream:
                return stream.read(max(map(len, BEGINNINGS))).startswith(BEGINNINGS)
    return False


def state_of(log: Path) -> tuple[int, int] | None:
    """Return size and time of change, None if the file cannot be examined."""
    with suppress(OSError):  # the reader of the file reports the problem
        status = log.stat()
        return status.st_size, status.st_mtime_ns
    return None


def size_of(log: Path) -> int:
    """Return the bytes of a log, 0 if it cannot be examined."""
    return (state_of(log) or (0, 0))[0]
