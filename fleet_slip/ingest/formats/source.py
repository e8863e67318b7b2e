"""The common interface of formats: a table of named columns for each time base of a file.

A format that stores the times of samples (MDF, CAN traces) has a clock: its times are the column
`OWN_TIME`, in s, since 1970 if the file has the date. In other formats time is an ordinary column.
"""

import difflib
import errno
import logging
import re
import tempfile
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import polars as pl

from fleet_slip.base import quote_name, require_extra
from fleet_slip.errors import InputError, MissingColumnError

OWN_TIME = "\0time"
"""Column of times in s, in files with clocks."""
BASE = "\0base"
"""Column with the number of a row's time base, if there are several."""

EARLIEST_S = 10**8
"""Earliest start that is a date, in 1973: loggers without a clock state 0, LabVIEW states 1904."""


def clock_start_s(start: datetime, zone: str | None) -> float:
    """Return the start of a clock in s since 1970, 0 without a date.

    A start without a time zone is in `zone`, else in UTC.
    """
    if start.tzinfo is None:
        start = start.replace(tzinfo=ZoneInfo(zone) if zone else UTC)
    start_s = start.timestamp()
    return start_s if start_s > EARLIEST_S else 0.0


MAX_COLUMNS = 10_000

_SHOWN_COLUMNS = 30


@dataclass(frozen=True)
class Channel:
    """A column that a file has.

    Attributes
    ----------
    name
        Its name in a mapping.
    unit
        Its unit in the file, empty if there is none.
    base
        Its time base; channels of one base form a table.
    title
        Its meaning, if the format defines it by the name.
    """

    name: str
    unit: str = ""
    base: str = ""
    title: str = ""


class Source(ABC):
    """A file that is open for reading.

    A format implements `find` and `read`; a source of several files implements `bases`.
    """

    has_clock = False
    """True if its times are in `OWN_TIME`."""

    @abstractmethod
    def channels(self) -> list[Channel]:
        """Return all that can be read, in the file's order."""

    def unreadable(self) -> list[str]:
        """Return why parts of the file are not read."""
        return []

    def find(self, column: str) -> tuple[str, Any]:
        """Return the name of a column's time base, and its place there. Raises `InputError`."""
        raise NotImplementedError

    def read(self, base: str, places: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield the rows of some columns of a base, in bounded batches, at least one."""
        raise NotImplementedError

    def bases(self, columns: Sequence[str]) -> list[Iterator[pl.DataFrame]]:
        """Return the rows of each time base that has one of the columns.

        A file without a clock has one base. The rows are in the file's order, in one or more
        bounded batches. Columns are text, 64-bit floats or integers, dates or timestamps; with a
        clock, `OWN_TIME` is one of them. Raises `InputError`, also for a missing or ambiguous
        column.
        """
        places_by_base: dict[str, dict[str, Any]] = {}
        for column in columns:
            base, place = self.find(column)
            places_by_base.setdefault(base, {})[column] = place
        return [self.read(base, places) for base, places in places_by_base.items()]

    def batches(self, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield the rows of each time base that has one of the columns, base by base."""
        for base in self.bases(columns):
            yield from base


def load_library(file: Path, package: str) -> Any:
    """Import a package of the extra `logs` and silence its log. Passes on its errors."""
    with require_extra("logs", f"{quote_name(file)}: its format"):
        module = import_module(package)
    logging.getLogger(package.partition(".")[0]).setLevel(logging.CRITICAL)
    return module


def unreadable(file: object, error: BaseException) -> InputError:
    """Return the error of a file for which a library raised `error`."""
    reason = quote_name(str(error).strip().split("\n")[0][:200]) or type(error).__name__
    return InputError(
        f"{quote_name(file)}: cannot be read: {reason}. Is it complete? Copy it again, or export "
        "it in "
        "another format."
    )


def as_column(file: Path, name: str, values: np.ndarray[Any, Any]) -> pl.Series:
    """Return an array as text, timestamps, 64-bit integers or floats.

    Integers of 64 bits may be identifiers, whose digits a float would lose. Raises `InputError` for
    other types.
    """
    kind = values.dtype.kind
    if values.ndim != 1 or kind not in "SUOMiufb":
        shape = " x ".join(map(str, values.shape))
        raise InputError(
            f"{quote_name(file)}: channel {name!r} has {shape} values of the type {values.dtype}, "
            "not one number or text a row. Map another one, or one of its columns."
        )
    if kind == "S":
        return pl.Series(name, [text.decode("utf-8", "replace").strip("\0") for text in values])
    if kind in "UO":
        return pl.Series(name, [str(text) for text in values], pl.String)
    if kind == "M":
        return pl.Series(name, values.astype("M8[us]"))
    is_long = kind in "iu" and values.dtype.itemsize == 8
    number = values.dtype.newbyteorder("=") if is_long else np.dtype(np.float64)
    return pl.Series(name, np.ascontiguousarray(values, dtype=number))


_NO_STATE = re.compile(
    r"sna|n/?a|nan|invalid|not.?(avail|valid|defined|used)|error|fault|fail|init|reserved|undefined"
    r"|unknown|default|nicht.?verf|ung(ue|ü)ltig|fehler|signal_?ung",
    re.IGNORECASE,
)
"""Pattern of value names in databases that mean a missing value."""


def names_states(texts: Iterable[str]) -> bool:
    """Return True if names are states, such as P, R, N, D, and not missing values."""
    return sum(not _NO_STATE.match(text.strip()) for text in texts) > 1


def is_missing_state(text: str) -> bool:
    """Return True for a name that means a missing value."""
    return _NO_STATE.match(text.strip()) is not None


def find_column(file: Path, names: Sequence[str], column: str) -> int:
    """Return the position of a column. Raises `InputError` for none or two of its name."""
    if len(names) > MAX_COLUMNS:
        raise InputError(
            f"{quote_name(file)}: {len(names):,} columns, at most {MAX_COLUMNS:,} are read."
        )
    same = [name for name in names if re.sub(r"@\d+$", "", name) == column]
    if len(same) > 1:
        raise InputError(
            f"{quote_name(file)}: {len(same)} columns are called {column!r}. Map one of "
            f"{', '.join(map(repr, same[:5]))}, or rename all but one."
        )
    if column not in names:
        raise missing_column(file, column, names)
    return names.index(column)


def describe_unknown(signal: str, signals: Iterable[str]) -> str:
    """Return the message for a signal that the catalog does not contain."""
    names = list(signals)
    similar = difflib.get_close_matches(signal, names, n=2, cutoff=0.7)
    similar += [name for name in names if signal in name.split("_") and name not in similar]
    hint = f" Do you mean {' or '.join(similar[:3])}?" if similar else ""
    return f"unknown signal {signal!r}.{hint} Known signals: {', '.join(names)}"


def missing_column(file: object, column: str, names: Sequence[str]) -> MissingColumnError:
    """Return the error of a column that is not among a file's."""
    folded = {name.casefold(): name for name in names}
    matches = difflib.get_close_matches(column.casefold(), folded, n=3, cutoff=0.6)
    similar = " or ".join(repr(folded[match][:80]) for match in matches)
    hint = f" Did the mapping mean {similar}?" if similar else ""
    present = ", ".join(repr(name[:80]) for name in names[:_SHOWN_COLUMNS])
    more = f" and {len(names) - _SHOWN_COLUMNS:,} more" if len(names) > _SHOWN_COLUMNS else ""
    return MissingColumnError(
        f"{quote_name(file)}: no column {column!r}.{hint} Its columns are {present}{more}. "
        "Correct the mapping, or leave the file out."
    )


# A small compressed file can decode to any size. The limits of decoding depend only on the size of
# the file. A measured log is far below them, since noise hardly compresses.

FREE_ROWS, ROWS_PER_BYTE = 10**6, 4
"""Maximum rows of any file, and rows for each of its bytes if these are more."""
FREE_BYTES, BYTES_PER_BYTE = 2**30, 200
"""Maximum bytes after decompression: of any file, and for each of its bytes."""
FREE_MEMORY, MEMORY_PER_BYTE = 2**30, 8
"""Maximum memory of a reader in bytes, and additional memory for each byte of its file."""
FREE_S, BYTES_PER_S = 60.0, 10**5
"""Maximum time to decode any file, in s, and the minimum speed of larger files."""


@dataclass(frozen=True)
class Budget:
    """The limits of decoding a file.

    Attributes
    ----------
    size
        Bytes of the file.
    rows, unfolded, memory
        Maximum number of rows, of bytes after decompression, and of bytes of a reader's memory.
    seconds
        Maximum time of decoding, in s.
    """

    file: Path
    size: int
    rows: int
    unfolded: int
    memory: int
    seconds: float

    @classmethod
    def for_file(cls, file: Path) -> "Budget":
        """Return the budget of a file. Raises `OSError`."""
        size = file.stat().st_size
        return cls(
            file,
            size,
            rows=max(FREE_ROWS, ROWS_PER_BYTE * size),
            unfolded=max(FREE_BYTES, BYTES_PER_BYTE * size),
            memory=FREE_MEMORY + MEMORY_PER_BYTE * size,
            seconds=max(FREE_S, size / BYTES_PER_S),
        )

    def require_rows(self, rows: int) -> None:
        """Raise `InputError` for more rows than a file of its size can have."""
        if rows > self.rows:
            raise self.exceeded(f"it has more than {self.rows:,} rows")

    def require_unfolded(self, size: int) -> None:
        """Raise `InputError` for more bytes than a file of its size can unfold to."""
        if size > self.unfolded:
            raise self.exceeded(f"it decompresses to more than {self.unfolded:,} bytes")

    def crashed(self) -> InputError:
        """Return the error of a file whose reader ended, is invalid, or exceeds its limits."""
        return self.exceeded(
            f"its reader crashed, or needs more than {self.memory:,} bytes, or {self.unfolded:,} "
            "in a temporary file"
        )

    def over_time(self) -> InputError:
        """Return the error of a file that took too long."""
        return self.exceeded(f"decoding it took more than {self.seconds:,.0f} s")

    def exceeded(self, problem: str) -> InputError:
        """Return the error of a file that exceeds a limit for its size."""
        return self.error(
            f"{problem}, the limit for its {self.size:,} bytes. Is it damaged? If it is a real "
            "recording, export it as uncompressed CSV."
        )

    def error(self, text: str) -> InputError:
        """Return an error that names the file."""
        return InputError(f"{quote_name(self.file)}: {text}")

    def metered(self, batches: Iterator[pl.DataFrame]) -> Iterator[pl.DataFrame]:
        """Yield batches within the limits of rows and time; the caller's time does not count."""
        rows, seconds = 0, 0.0
        while True:
            began = time.monotonic()
            batch = next(batches, None)
            seconds += time.monotonic() - began
            if seconds > self.seconds:
                raise self.over_time()
            if batch is None:
                return
            rows += batch.height
            self.require_rows(rows)
            yield batch


IN_MEMORY_BYTES = 2**24
"""Maximum size in memory; a larger spool is a temporary file."""


class Spool:
    """Pieces of bytes by key, in their order, beyond 16 MiB in a temporary file without a name."""

    def __init__(self) -> None:
        """Begin without pieces."""
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES)  # noqa: SIM115 - as long as this
        self._pieces: dict[Hashable, list[tuple[int, int]]] = defaultdict(list)
        self._end = 0

    def add(self, key: Hashable, piece: bytes) -> None:
        """Keep a piece. Raises `InputError` if the disk is full."""
        try:
            self._file.seek(self._end)
            self._file.write(piece)
            self._file.flush()
        except OSError as error:
            if error.errno == errno.EFBIG:  # a limit of our own, on a file that unfolds
                raise
            raise InputError(
                f"{tempfile.gettempdir()}: no room for a temporary copy of more than {self._end:,} "
                f"bytes ({error.strerror}). Free some, or name another folder in the environment "
                "variable TMPDIR."
            ) from None
        self._pieces[key].append((self._end, len(piece)))
        self._end += len(piece)

    def read(self, key: Hashable) -> Iterator[bytes]:
        """Yield the pieces of a key."""
        for start, size in self._pieces.get(key, ()):
            self._file.seek(start)
            yield self._file.read(size)
