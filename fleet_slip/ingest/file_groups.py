"""Several files of one drive as one log: the messages of a session in a lake, or files by patterns.

A column is `MEMBER/COLUMN`. The files of a member follow each other in time, and each member is a
time base. A lake is `DEVICE/MESSAGE/yyyy/mm/dd/SESSION_SPLIT.parquet`, as loggers of CAN write it:
its members are messages, with their times in the column `t`.
"""

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Mapping as Named
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from datetime import date
from pathlib import Path, PosixPath
from typing import Any

import polars as pl

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import TimeBase
from fleet_slip.ingest.formats.file_formats import FileFormats, PlainNumbers
from fleet_slip.ingest.formats.reading import open_source
from fleet_slip.ingest.formats.source import OWN_TIME, Channel, Source, missing_column

Members = Named[str, tuple[Path, ...]]
_Splits = dict[tuple[date, int], dict[str, Path]]
"""The files of a session by message, for each day and number of a split."""

_LAKE = re.compile(r"(.*/)?([^/]+)/([^/]+)/(\d{4})/(\d\d)/(\d\d)/(\d+)_(\d+)\.parquet")
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
        """Return the size of all files together, and the time of the last change."""
        states = [file.stat(follow_symlinks=follow_symlinks) for file in self.files]
        latest = max(states, key=lambda state: state.st_mtime_ns)
        fields = list(latest)
        fields[6] = sum(state.st_size for state in states)
        times = {"st_mtime_ns": latest.st_mtime_ns, "st_blocks": 0}
        return os.stat_result(fields, times)


def group_lake(files: Iterable[Path]) -> list[Path]:
    """Return logs with the files of a lake as a group for each device and session.

    A session goes on over midnight; where its number comes again later, it is another one.
    """
    files_alone: list[Path] = []
    sessions: dict[tuple[str, str, str], _Splits] = defaultdict(dict)
    for file in files:
        match = _LAKE.fullmatch(file.as_posix())
        if match is None:
            files_alone.append(file)
            continue
        above, device, message, year, month, day, session, split = match.groups()
        try:
            key = date(int(year), int(month), int(day)), int(split)
        except ValueError:
            files_alone.append(file)
            continue
        sessions[above or "", device, session].setdefault(key, {})[message] = file
    groups = [
        FileGroup.create(
            Path(above, device, f"{run[0][0].isoformat()}_{session}"), _by_message(run)
        )
        for (above, device, session), by_split in sessions.items()
        for run in _runs(sorted(by_split.items()))
    ]
    return [*files_alone, *sorted(groups)]


_Split = tuple[date, dict[str, Path]]


def _runs(splits: list[tuple[tuple[date, int], dict[str, Path]]]) -> Iterator[list[_Split]]:
    """Yield the splits of each session: of following days, with numbers that increase."""
    run: list[_Split] = []
    before = (date.min, -1)
    for (day, number), files in splits:
        if run and (number <= before[1] or (day - before[0]).days > 1):
            yield run
            run = []
        run.append((day, files))
        before = day, number
    yield run


def _by_message(splits: list[_Split]) -> dict[str, tuple[Path, ...]]:
    names = sorted({name for _, files in splits for name in files})
    return {name: tuple(files[name] for _, files in splits if name in files) for name in names}


def seconds_of(column: pl.Series, time: TimeBase, formats: FileFormats) -> pl.Series:
    """Return times in s, NaN for other texts. Raises `ValueError` for another type."""
    return column.to_frame().select(
        time.in_s(pl.col(column.name), column.dtype, decimal_comma=formats.csv.decimal_comma)
    )[column.name]


class GroupSource(Source):
    """The files of a group, open one after the other."""

    has_clock = True

    def __init__(self, group: FileGroup, formats: FileFormats, times: Named[str, TimeBase]) -> None:
        """Take the files, how they are written, and where the times of members are."""
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
                    times_s = self._seconds(rows[time], base, file).alias(OWN_TIME)
                    rows_with_times = rows.select(*names).rename(named).with_columns(times_s)
                    yield rows_with_times.filter(pl.col(OWN_TIME).is_not_null())

    def _seconds(self, column: pl.Series, time: TimeBase, file: Path) -> pl.Series:
        try:
            return seconds_of(column, time, self._formats)
        except ValueError as error:
            raise InputError(f"{quote_name(file)}: {error}") from None


def open_log(
    log: Path, formats: FileFormats, times: Named[str, TimeBase] | None = None
) -> AbstractContextManager[Source]:
    """Open a log, of one file or of several. Raises `InputError`."""
    if isinstance(log, FileGroup):
        return nullcontext(GroupSource(log, formats, times or {}))
    return open_source(log, formats)
