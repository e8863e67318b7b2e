"""What every module may use: results and their JSON, canonical JSON, days, extras, words."""

import hashlib
import json
import math
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from datetime import date, datetime
from decimal import Decimal
from typing import Any, overload

from fleet_slip.errors import ExtraError, UsageError

# What results are as JSON documents: one encoder for all of them.


class Record:
    """A dataclass of results, whose class says what is in its JSON document, key by key.

    `DOCUMENT` has words: `...` is every field; `name` is a field or a property; `key=a.b` is
    attribute `b` of attribute `a` under another name, null where `a` is None; `*name` is all keys
    of a record or mapping in its place; a `?` behind any leaves out what is None or empty.
    """

    DOCUMENT = "..."

    def as_dict(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        document: dict[str, Any] = {}
        for word in self.DOCUMENT.split():
            if word == "...":
                document |= _fields_of(self)
                continue
            key, _, path = word.strip("*?").rpartition("=")
            value: Any = self
            for name in path.split("."):
                value = None if value is None else getattr(value, name)
            value = document_of(value)
            if word.startswith("*"):
                document |= value or {}
            elif not word.endswith("?") or value not in (None, "", [], {}):
                document[key or path] = value
        return document


def document_of(value: Any) -> Any:
    """Return records, other dataclasses, mappings and sequences as a JSON document has them.

    Numbers that JSON does not know (NaN, infinity) become null. pydantic would write decimal
    numbers as texts.
    """
    if isinstance(value, Mapping):
        return {key: document_of(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [document_of(item) for item in value]
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    if hasattr(value, "as_dict"):
        return document_of(value.as_dict())
    if is_dataclass(value) and not isinstance(value, type):
        return _fields_of(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _fields_of(record: Any) -> dict[str, Any]:
    return {field.name: document_of(getattr(record, field.name)) for field in fields(record)}


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


def hash_fold(key: str, count: int) -> int:
    """Return the fold 0..count-1 of a key: its SHA-256 modulo the number of folds, for ever."""
    return int.from_bytes(hashlib.sha256(key.encode("utf-8")).digest()[:8], "big") % count


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
def require_extra(extra: str, purpose: str) -> Iterator[None]:
    """Import what an extra brings; raises `ExtraError` that says how to install it and what for."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package == "fleet_slip":
            raise
        raise ExtraError(
            f"{purpose} needs the package {package}, which is not installed. "
            f"Run: pip install 'fleet-slip[{extra}]'"
        ) from None


# How long work tells of its progress.

Progress = Callable[[int, int], None]
"""Called with the units done since the last call, and the units to do in all: rows or bytes."""


def no_progress(_more: int, _all: int) -> None:
    """Tell nobody."""


# Names of cars, drives and places, as logs, Gram rows and people write them.

MAX_NAME_CHARACTERS = 200
"""Longest name of a car, drive or place."""


def normalize_name(text: str) -> str:
    """Return the form in which a name is stored: Unicode NFC, without spaces around it."""
    return unicodedata.normalize("NFC", text).strip()


def find_name_fault(name: str) -> str | None:
    """Return why a normalized name is refused; None for a valid name."""
    if not name:
        return "is empty"
    if len(name) > MAX_NAME_CHARACTERS:
        return f"has more than {MAX_NAME_CHARACTERS} characters"
    if not name.isprintable():
        return "has characters that cannot be printed"
    return None


def name_key(name: str) -> str:
    """Return the key by which erasure compares names: the normalized name after case folding."""
    return normalize_name(unicodedata.normalize("NFD", name).casefold())


# How messages say numbers with their nouns, and names from strangers.


def pluralize(number: int, noun: str) -> str:
    """Return a number of things, such as `1 drive` or `1,500 Gram rows`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def quote_name(text: object) -> str:
    """Return a name as it can stand in a one-line message, whatever characters it has."""
    plain = str(text)
    return plain if plain.isprintable() else repr(plain)
