"""What every module may use: canonical JSON, days, optional packages, words."""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import date, datetime
from typing import TYPE_CHECKING, Any, overload

from fleet_slip.errors import ExtraError, UsageError

if TYPE_CHECKING:
    pass


# The one text of JSON content, whatever its order and layout, and the checksum of a text.

_TEXT = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
_ASCII = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False)


def canonical_json(content: Any) -> str:
    """Return JSON with sorted keys, no spaces, no escapes. Raises `ValueError` for NaN."""
    return _TEXT.encode(content)


def canonical_ascii(content: Any) -> str:
    """Return `canonical_json` with escapes beyond ASCII, for checksums of older documents."""
    return _ASCII.encode(content)


def sha256_of(text: str) -> str:
    """Return the SHA-256 of a text in UTF-8, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


# Days as people write them, in options and in calls.

EXAMPLE = "2024-05-01"


@overload
def date_of(day: date | str, name: str, example: str = EXAMPLE) -> date: ...
@overload
def date_of(day: date | str | None, name: str, example: str = EXAMPLE) -> date | None: ...


def date_of(day: date | str | None, name: str, example: str = EXAMPLE) -> date | None:
    """Return the day that an option or argument names; of a time, its day.

    Raises `UsageError` for anything but a date.
    """
    if isinstance(day, datetime):
        return day.date()
    if day is None or isinstance(day, date):
        return day
    try:
        return date.fromisoformat(day)
    except (ValueError, TypeError):
        raise UsageError(f"{name} {day}: not a date; write it as {example}.") from None


def last_day(through: date | str | None, name: str = "--through") -> date | None:
    """Return the last day that is named. Raises `UsageError` for anything but a date or today."""
    return date.today() if through == "today" else date_of(through, name, f"{EXAMPLE}, or today")


# The optional parts of the package: what says which one to install, where one is missing.


@contextmanager
def needed(extra: str, purpose: str) -> Iterator[None]:
    """Import what an extra brings; raises `ExtraError` that says how to install it and what for."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package == "fleet_slip":
            raise
        raise missing(extra, purpose, package) from None


def missing(extra: str, purpose: str, package: str) -> ExtraError:
    """Return the error that says how to install an extra."""
    return ExtraError(
        f"{purpose} needs the package {package}, which is not installed. "
        f"Run: pip install 'fleet-slip[{extra}]'"
    )


# How long work tells of its progress.

Progress = Callable[[int, int], None]
"""Called with the units done since the last call, and the units to do in all: rows or bytes."""


def no_progress(_more: int, _all: int) -> None:
    """Tell nobody."""


# How messages say numbers with their nouns, and names from strangers.


def number_of(number: int, noun: str) -> str:
    """Return a number of things, such as `1 drive` or `1,500 Gram rows`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def shown(text: object) -> str:
    """Return a name as it can stand in a one-line message, whatever characters it has."""
    plain = str(text)
    return plain if plain.isprintable() else repr(plain)
