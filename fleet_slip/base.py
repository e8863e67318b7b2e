"""Basics of all modules: JSON of results, canonical JSON, dates, extras, names."""

import hashlib
import json
import math
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from datetime import date, datetime
from decimal import Decimal
from typing import Any

from fleet_slip.errors import ExtraError, UsageError

# JSON documents of results.


class Record:
    """A dataclass whose `DOCUMENT` declares the keys of its JSON document, separated by spaces.

    `...`: every field. `name`: a field or property. `key=a.b`: attribute `b` of attribute `a` as
    `key`, null if `a` is None. `*name`: all keys of a record or mapping. A trailing `?` omits None
    and empty values.
    """

    DOCUMENT = "..."

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document, which `--json` prints."""
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
    """Convert records, dataclasses, mappings and sequences to JSON values.

    NaN and infinity become null. Decimal numbers become numbers, which pydantic writes as text.
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


# Canonical JSON, which does not depend on order and layout, and checksums.

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
    """Return the fold 0..count-1 of a key: the first 8 bytes of its SHA-256, modulo `count`."""
    return int.from_bytes(hashlib.sha256(key.encode("utf-8")).digest()[:8], "big") % count


# Dates in options and arguments.

EXAMPLE = "2024-05-01"


def date_of(day: date | str | None, name: str, example: str = EXAMPLE) -> date | None:
    """Parse a date; return the day of a time. Raises `UsageError` for anything else."""
    if isinstance(day, datetime):
        return day.date()
    if day is None or isinstance(day, date):
        return day
    try:
        return date.fromisoformat(day)
    except (ValueError, TypeError):
        raise UsageError(f"{name} {day}: not a date; write it as {example}.") from None


def last_day(through: date | str | None) -> date | None:
    """Parse a date or "today". Raises `UsageError` for anything else."""
    if through == "today":
        return date.today()
    return date_of(through, "through", f"{EXAMPLE}, or today")


# Extras of the package.


@contextmanager
def require_extra(extra: str, purpose: str) -> Iterator[None]:
    """Translate failed imports of an extra's packages to `ExtraError` with the install command."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package == "fleet_slip":
            raise
        raise ExtraError(
            f"{purpose} needs the package {package}, which is not installed. "
            f"{install_command(extra)}"
        ) from None


def install_command(extra: str) -> str:
    """Return a sentence with the commands that install an extra."""
    return f'Run: pip install "fleet-slip[{extra}]", or start by: uvx "fleet-slip[{extra}]" …'


# Progress of long work.

Progress = Callable[[int, int], None]
"""Called with the work since the last call and the total work, in rows or bytes."""


def no_progress(_more: int, _all: int) -> None:
    """Ignore progress."""


Steps = Callable[[str], Progress]
"""Returns the progress of a step by its name."""


def no_steps(_name: str) -> Progress:
    """Ignore the progress of all steps."""
    return no_progress


# Names of cars, drives and places.

MAX_NAME_CHARACTERS = 200
"""Longest name of a car, drive or place."""


def normalize_name(text: str) -> str:
    """Return the stored form of a name: Unicode NFC, without surrounding spaces."""
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


# Words of messages.


def pluralize(number: int, noun: str) -> str:
    """Return a number with its noun, such as `1 drive` or `1,500 Gram rows`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def quote_name(text: object) -> str:
    """Return a name for a one-line message: quoted if it has unprintable characters."""
    plain = str(text)
    return plain if plain.isprintable() else repr(plain)
