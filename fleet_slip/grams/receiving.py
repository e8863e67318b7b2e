"""Takes in messages of cars that send Gram rows: rows without a log, beside those with one.

A received Gram row names no log file but `received/` and a digest of the file of messages that
brought it; its drive has the source `received`. A file of messages lands once. So does a message:
the same one again is a duplicate, another one of the same drive is refused. What is refused goes to
the quarantine with the reason, first.
"""

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from functools import lru_cache
from pathlib import Path

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.delta import Unit, retry_conflicts
from fleet_slip.errors import InputError
from fleet_slip.grams.messages import Message, read_messages, signals_definition
from fleet_slip.grams.plausible import find_impossible
from fleet_slip.grams.received_rows import (
    Landing,
    ReceivedRow,
    Refused,
    arrays_of,
    by_mask,
    choose_rows,
    land_refused,
    land_rows,
    signals_of,
)
from fleet_slip.progress import Progress, no_progress
from fleet_slip.warehouse.tables import Warehouse

LARGEST_FILE_BYTES = 2**28
FIRST_START_S = 946_684_800
"""2000-01-01: a car's clock that says less has not been set."""

LAST_START_S = 4_102_444_800
"""2100-01-01."""

_VEHICLE = re.compile(rb"[A-Za-z0-9._-]+")


@dataclass
class ReceiveReport:
    """What became of a file of messages.

    Attributes:
        file: its path.
        new: whether it had not landed before.
        messages: in it, the refused ones included.
        received: Gram rows that landed.
        rows: of drives, in these.
        duplicates: messages that had landed.
        forgotten: messages of cars or drives that were forgotten: left out.
        refused: how many messages went to the quarantine, by reason.
    """

    file: str
    new: bool = True
    messages: int = 0
    received: int = 0
    rows: int = 0
    duplicates: int = 0
    forgotten: int = 0
    refused: Counter[str] = field(default_factory=Counter)


def receive_files(
    warehouse: Warehouse, files: Sequence[Path], progress: Progress = no_progress
) -> Iterator[ReceiveReport]:
    """Take in files of messages, one after the other; yield a report of each once it has landed.

    `progress` counts files. Raises `InputError` for a file that cannot be read, `StorageError`, and
    `ConflictError` if other processes keep changing the tables.
    """
    for path in files:
        yield _receive_file(warehouse, path)
        progress(1, len(files))


def find_messages(given: Iterable[Path]) -> list[Path]:
    """Return files, and those in folders at any depth, in the order of their names.

    Raises `InputError` for what is neither, and for a folder without files.
    """
    found: list[Path] = []
    for path in given:
        inside = sorted(one for one in path.rglob("*") if one.is_file()) if path.is_dir() else []
        if not inside and not path.is_file():
            raise InputError(f"{path}: is no file of messages, and no folder that has some.")
        found += inside or [path]
    return found


def _receive_file(warehouse: Warehouse, path: Path) -> ReceiveReport:
    content = _read(path)
    digest = hashlib.sha256(content).hexdigest()
    unit = Unit(f"receive/{digest}", 1)
    report = ReceiveReport(str(path))
    if warehouse.grams.snapshot().landed(unit.name) is not None:
        report.new = False
        return report
    rows, refused = _sorted_out(content)
    report.messages = len(rows) + len(refused)
    rows, impossible = _possible(rows)
    refused += impossible

    def attempt() -> Landing:
        landing = choose_rows(warehouse, rows, refused)
        land_refused(warehouse, path.name, unit, landing.refused)
        land_rows(warehouse, digest, unit, landing)
        return landing

    landing = retry_conflicts(attempt)
    report.refused = Counter(one.reason for one in landing.refused)
    report.duplicates, report.forgotten = landing.duplicates, landing.forgotten
    report.received = len(landing.new)
    report.rows = sum(row.message.rows for row in landing.new)
    return report


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_FILE_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}.") from None
    if len(content) > LARGEST_FILE_BYTES:
        raise InputError(
            f"{path}: has more than {LARGEST_FILE_BYTES:,} bytes. Messages stand one behind the "
            "other, so that a file can be cut between them."
        )
    if not content:
        raise InputError(f"{path}: is empty.")
    return content


def _sorted_out(content: bytes) -> tuple[list[ReceivedRow], list[Refused]]:
    """Return the messages that say what they must, and the others."""
    rows: list[ReceivedRow] = []
    refused: list[Refused] = []
    for number, (_, message) in enumerate(read_messages(content), 1):
        if isinstance(message, str):
            refused.append(Refused(number, message))
            continue
        row = _row_of(number, message)
        if isinstance(row, str):
            refused.append(Refused(number, row))
        elif message.lost:
            refused.append(row.refuse("lacks rows of its drive"))
        else:
            rows.append(row)
    return rows, refused


def _row_of(number: int, message: Message) -> ReceivedRow | str:
    if message.definition != signals_definition():
        return "is of signals that mean something else here"
    if message.mask >> len(catalogue().gram_signals) or message.place >= message.parts:
        return "is of signals or parts that there are not"
    if not _VEHICLE.fullmatch(message.vehicle):
        return "has no name of a car"
    if not FIRST_START_S <= message.start_s < LAST_START_S:
        return "begins at no time between 2000 and 2100"
    vehicle = message.vehicle.decode("ascii")
    moment, day = _began(message.start_s)
    return ReceivedRow(number, message, vehicle, f"{vehicle}-{moment}", day)


@lru_cache(100_000)
def _began(start_s: int) -> tuple[str, date]:
    """Return when a drive began, as its name has it, and the day."""
    began = datetime.fromtimestamp(start_s, UTC)
    return f"{began:%Y%m%dT%H%M%SZ}", began.date()


def _possible(rows: Sequence[ReceivedRow]) -> tuple[list[ReceivedRow], list[Refused]]:
    """Return the Gram rows that counts can have, and the others."""
    signals = catalogue()
    kept: list[ReceivedRow] = []
    refused: list[Refused] = []
    for mask, some in by_mask(rows).items():
        names = [name for name in signals_of(mask).split(",") if name]
        ranges = [(signals[name].min_count, signals[name].max_count) for name in names]
        for row, why in zip(some, find_impossible(*arrays_of(some), ranges), strict=True):
            if why is None:
                kept.append(row)
            else:
                refused.append(row.refuse(why))
    return kept, refused
