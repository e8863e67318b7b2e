"""Time bases that go on from file to file of a log, each file open only while it is read."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.reading import file_errors
from fleet_slip.ingest.formats.source import Base
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.words import shown

_OpenIt = Callable[[Path], AbstractContextManager[tuple[list[Base], set[str]]]]


@dataclass
class _Opened:
    """An open file, its time bases, and how many of them are being read."""

    file: ExitStack
    bases: list[Base]
    columns: set[str]
    readers: int = 0


class PartBases:
    """Opens the files of a log, each once for all who read a time base of it at a time."""

    def __init__(self, open_it: _OpenIt) -> None:
        """Take what opens a file: it gives its time bases, and which columns they have."""
        self._open_it = open_it
        self._opened: dict[Path, _Opened] = {}

    def __enter__(self) -> "PartBases":
        """Begin without open files."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close what readers have left open."""
        for part in [*self._opened]:
            self._opened.pop(part).file.close()

    @contextmanager
    def using(self, part: Path) -> Iterator[_Opened]:
        """Give a file, open as long as somebody uses it."""
        if part not in self._opened:
            with ExitStack() as file:
                bases, columns = file.enter_context(self._open_it(part))
                self._opened[part] = _Opened(file.pop_all(), bases, columns)
        opened = self._opened[part]
        opened.readers += 1
        try:
            with file_errors(part):
                yield opened
        finally:
            opened.readers -= 1
            if not opened.readers and self._opened.get(part) is opened:
                del self._opened[part]
                opened.file.close()


@dataclass(frozen=True)
class _Stretch:
    """The rows of a time base in one file: which of its bases it is, and how many there are."""

    part: Path
    place: int
    first_s: float
    rows: int


def join_parts(log: Path, parts: list[Path], mapping: Mapping, opened: PartBases) -> list[Base]:
    """Return the time bases of a log: what has the same columns goes on from file to file.

    Files follow each other in the order of their first times. Raises `InputError` for a column that
    no file has.
    """
    time = str(mapping.time.key)
    missing = {name for names in mapping.time_bases().values() for name in names}
    found: dict[str, list[_Stretch]] = defaultdict(list)
    for part in parts:
        with opened.using(part) as there:
            missing -= there.columns
            for place, base in enumerate(there.bases):
                first = next(base.read())
                name = " ".join(sorted({*first.columns, time}))
                found[name].append(_Stretch(part, place, _first_s(first[time]), base.count_rows()))
    if missing:
        raise InputError(f"{shown(log)}: no file in it has the column {min(missing)!r}.")
    for stretches in found.values():
        stretches.sort(key=lambda stretch: stretch.first_s)
    names = sorted(found, key=lambda name: found[name][0].first_s)
    return [
        Base(
            name,
            partial(sum, [stretch.rows for stretch in found[name]]),
            partial(_read, opened, found[name]),
        )
        for name in names
    ]


def _read(opened: PartBases, stretches: list[_Stretch]) -> Iterator[pl.DataFrame]:
    for stretch in stretches:
        with opened.using(stretch.part) as there:
            yield from there.bases[stretch.place].read()


def _first_s(times: pl.Series) -> float:
    first = times.min()
    return first if isinstance(first, float) else 0.0
