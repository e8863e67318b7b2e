"""Finds measured logs on this machine: files, those of a folder or a pattern, and groups of files.

Several files of one drive are one log, a `FileGroup`.
"""

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Mapping as Named
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from datetime import date, datetime
from glob import glob
from pathlib import Path, PosixPath
from typing import Any

import polars as pl

from fleet_slip.base import pluralize, quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import TimeBase
from fleet_slip.ingest.formats.file_formats import FileFormats, PlainNumbers
from fleet_slip.ingest.formats.reading import BEGINNINGS, SUFFIXES, StrayLink, open_source
from fleet_slip.ingest.formats.source import OWN_TIME, Channel, Source, missing_column
from fleet_slip.ingest.mapping import FilePattern, Mapping

_COMPANIONS = (
    ".toml", ".dbc", ".kcd", ".sym", ".arxml", ".a2l", ".md", ".json", ".yaml", ".yml", ".pdf",
    ".png", ".jpg", ".py", ".sh", ".tdms_index",
)  # fmt: skip
"""Suffixes of files beside logs that are not logs."""

WILDCARDS = frozenset("*?[")


class LogFiles(list[Path]):
    """Logs, and in `passed_over` the files of their folders without the suffix of a log."""

    def __init__(self, logs: Iterable[Path], passed_over: Iterable[Path]) -> None:
        """Take the logs and the files that are passed over."""
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
            "folder of your logs."
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
        raise InputError(f"{quote_name(pattern)}: no file matches this pattern. See its folder.")
    plain = [part for part in pattern.parents if not WILDCARDS.intersection(str(part))]
    return _without_strays(files, plain[0])


def _without_strays(files: list[Path], folder: Path) -> list[Path]:
    """Return the files below a folder; those behind links out of it as `StrayLink`."""
    top = os.path.realpath(folder)
    return [file if _is_inside(file, top) else StrayLink(file) for file in files]


def _is_inside(path: Path, top: str) -> bool:
    return os.path.commonpath([top, os.path.realpath(path)]) == top


def _logs_below(folder: Path, passed_over: list[Path]) -> Iterator[Path]:
    """Yield the logs below a folder, and the linked folders elsewhere, which are not read."""
    top = os.path.realpath(folder)
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        links = [path for name in folders if (path := Path(parent, name)).is_symlink()]
        yield from (link for link in links if not _is_inside(link, top))
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
        if file.is_file():  # opening a pipe would wait
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


# Several files of one drive as one log: the messages of a session in a lake, or files by patterns.
#
# A column is `MEMBER/COLUMN`. The files of a member follow each other in time, and each member is a
# time base. A lake is `DEVICE/MESSAGE/yyyy/mm/dd/SESSION_SPLIT.parquet`, as CAN loggers write it:
# its members are messages, with their times in the column `t`.

Members = Named[str, tuple[Path, ...]]
_LAKE = re.compile(r"(.*/)?([^/]+)/([^/]+)/(\d{4}/\d\d/\d\d)/(\d+)_(\d+)\.parquet")
_TIMES = ("t", "time", "timestamp")
"""Columns of times in the files of a lake."""


class FileGroup(PosixPath):
    """The files of a drive by member; its path is the folder and the name of the drive."""

    members: Members

    @classmethod
    def create(cls, path: Path, members: Members) -> "FileGroup":
        """Return the group of this name."""
        group = cls(path)
        group.members = members
        return group

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the arguments that rebuild this in another process."""
        return FileGroup.create, (Path(self), self.members)

    @property
    def files(self) -> list[Path]:
        """All files, member by member."""
        return [file for files in self.members.values() for file in files]

    def absolute(self) -> "FileGroup":
        """Return the group of absolute paths."""
        members = {n: tuple(f.absolute() for f in files) for n, files in self.members.items()}
        return FileGroup.create(Path(self).absolute(), members)

    def is_file(self) -> bool:
        """Return True if all are files."""
        return all(file.is_file() for file in self.files)

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Return the total size of all files, and the time of the last change."""
        states = [file.stat(follow_symlinks=follow_symlinks) for file in self.files]
        latest = max(states, key=lambda state: state.st_mtime_ns)
        size = sum(state.st_size for state in states)
        times = {"st_mtime_ns": latest.st_mtime_ns, "st_blocks": 0}
        return os.stat_result([*latest[:6], size, *latest[7:10]], times)


def group_lake(files: Iterable[Path]) -> list[Path]:
    """Return logs with the files of a lake as a group for each device and session.

    A session may continue over midnight. The same number later, or with a smaller split, is a new
    session.
    """
    files_alone: list[Path] = []
    sessions = defaultdict[Path, list[tuple[date, int, str, Path]]](list)
    for file in files:
        match = _LAKE.fullmatch(file.as_posix())
        day = None
        with suppress(ValueError):  # a day that does not exist
            day = datetime.strptime(match[4], "%Y/%m/%d").date() if match else None
        if match is None or day is None:
            files_alone.append(file)
            continue
        above, device, message, _, session, split = match.groups()
        sessions[Path(above or "", device, session)].append((day, int(split), message, file))
    groups: list[Path] = []
    for path, files_of_session in sessions.items():
        runs: list[tuple[date, dict[str, list[Path]]]] = []
        before = (date.min, -1)
        for day, split, message, file in sorted(files_of_session):
            is_next = split > before[1] and (day - before[0]).days <= 1
            if (day, split) != before and not (runs and is_next):
                runs.append((day, defaultdict(list)))
            runs[-1][1][message].append(file)
            before = day, split
        groups += [
            FileGroup.create(
                path.with_name(f"{first_day.isoformat()}_{path.name}"),
                {name: tuple(by_message[name]) for name in sorted(by_message)},
            )
            for first_day, by_message in runs
        ]
    return [*files_alone, *sorted(groups)]


def seconds_of(column: pl.Series, time: TimeBase, formats: FileFormats, log: Path) -> pl.Series:
    """Return times in s, NaN for other texts. Raises `InputError` for another type."""
    comma = formats.csv.decimal_comma
    try:
        seconds = time.to_seconds(pl.col(column.name), column.dtype, decimal_comma=comma)
    except ValueError as error:
        raise InputError(f"{quote_name(log)}: {error}") from None
    return column.to_frame().select(seconds)[column.name]


class GroupSource(Source):
    """The files of a group, open one after the other."""

    has_clock = True

    def __init__(self, group: FileGroup, formats: FileFormats, times: Named[str, TimeBase]) -> None:
        """Take the files, their formats, and the columns of times by member."""
        self._group, self._times = group, times
        self._formats = replace(formats, plain_numbers=PlainNumbers())
        self._channels: dict[str, list[Channel]] = {}

    def _channels_of(self, member: str) -> list[Channel]:
        """Return the columns of a member's first file."""
        if member not in self._channels:
            with open_source(self._group.members[member][0], self._formats) as source:
                self._channels[member] = source.channels()
        return self._channels[member]

    def channels(self) -> list[Channel]:
        """Return the columns of all members."""
        return [
            replace(channel, name=f"{member}/{channel.name}", base=f"{member}/{channel.base}")
            for member in self._group.members
            for channel in self._channels_of(member)
            if channel.name != self._time_column(member)
        ]

    def _time_column(self, member: str) -> str | None:
        """Return the column of a member's times; None if the file has a clock or no such column."""
        if member in self._times:
            return self._times[member].column
        names = [channel.name for channel in self._channels_of(member)]
        return next((name for name in names if name.casefold() in _TIMES), None)

    def bases(self, columns: Sequence[str]) -> list[Iterator[pl.DataFrame]]:
        """Return the rows of each time base of each member. Raises `InputError`."""
        by_base: dict[tuple[str, str], list[str]] = {}
        for column in columns:
            member, _, name = column.partition("/")
            if member not in self._group.members:
                raise missing_column(self._group, column, [c.name for c in self.channels()])
            bases = {channel.name: channel.base for channel in self._channels_of(member)}
            by_base.setdefault((member, bases.get(name, "")), []).append(name)
        return [self._rows(member, names) for (member, _), names in by_base.items()]

    def _rows(self, member: str, names: list[str]) -> Iterator[pl.DataFrame]:
        """Yield columns of a member, with their times, file by file."""
        named = {name: f"{member}/{name}" for name in names}
        for file in self._group.members[member]:
            with open_source(file, self._formats) as source:
                if source.has_clock:
                    yield from (rows.rename(named) for rows in source.batches(names))
                    continue
                time = self._time_column(member)
                if time is None:
                    raise InputError(
                        f"{quote_name(file)}: no column of times. Name it in the mapping: [[file]] "
                        f'name = "{member}", time = {{ column = … }}.'
                    )
                base = self._times.get(member) or TimeBase(column=time)
                for rows in source.batches(list(dict.fromkeys([time, *names]))):
                    times_s = seconds_of(rows[time], base, self._formats, file).alias(OWN_TIME)
                    rows_with_times = rows.select(*names).rename(named).with_columns(times_s)
                    yield rows_with_times.drop_nulls(OWN_TIME)


def open_log(
    log: Path, formats: FileFormats, times: Named[str, TimeBase] | None = None
) -> AbstractContextManager[Source]:
    """Open a log, of one file or of several. Raises `InputError`."""
    if isinstance(log, FileGroup):
        return nullcontext(GroupSource(log, formats, times or {}))
    return open_source(log, formats)
