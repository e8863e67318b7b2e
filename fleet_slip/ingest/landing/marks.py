"""Recognises what is in the logs, by the bytes of a file or the counts of a drive.

A mark is a unit of work beside that of its file, in the same commit: two processes that land the
same drive at once are in conflict, and one of them is told. Its name is a digest, of all bytes of a
file or of the counts of a drive; its number says of which content and drive:

    40 bits of the content's digest | 3 bits: 0 of a file | 20 bits of the drive's name

Names of cars and drives do not follow from it.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from hashlib import sha256

from fleet_slip.delta import WITHDRAWN, Unit

FILES, PREFIX = "ingest/", "same/"
DIGEST_CHARACTERS = 10
_DRIVE_BITS, _MARK_BITS = 20, 3
WHOLE_FILE = 0

MEASURED = rf"-([0-9a-f]{{{DIGEST_CHARACTERS}}})[0-9a-f]{{2}}((-[0-9]+){{1,2}})$"
"""What the name of a measured drive ends in: its file's digest, and which drive of it."""

_MEASURED = re.compile(MEASURED)


@dataclass(frozen=True, order=True)
class Origin:
    """What a mark is of: the first characters of a digest, and a drive's hash or the whole file."""

    digest: str
    drive: int = WHOLE_FILE

    @classmethod
    def of(cls, digest: str) -> "Origin":
        """Return the origin of a file with this digest."""
        return cls(digest[:DIGEST_CHARACTERS])

    @classmethod
    def of_drive(cls, drive_id: str) -> "Origin | None":
        """Return the origin of a drive; None if its name is not that of a measured one."""
        if (found := _MEASURED.search(drive_id)) is None:
            return None
        hashed = int(sha256(found[2].encode()).hexdigest(), 16)
        return cls(found[1], 1 + hashed % (2**_DRIVE_BITS - 1))

    @property
    def file(self) -> "Origin":
        """The file that it is, or is in."""
        return Origin(self.digest)


def mark_file(digest: str, content: str) -> dict[str, int]:
    """Return the mark of a file, by its digest and that of its bytes alone."""
    return {f"{PREFIX}{content[:16]}": _number(Origin.of(digest))}


def mark_drive(drive_id: str, counts_digest: str) -> dict[str, int]:
    """Return the mark of a measured drive."""
    origin = Origin.of_drive(drive_id)
    return {f"{PREFIX}{counts_digest}": _number(origin)} if origin else {}


class KnownMarks:
    """The marks of what is in the logs."""

    def __init__(self, units: Mapping[str, int]) -> None:
        """Take the units of a snapshot of the logs."""
        self._numbers = {
            name: number
            for name, number in units.items()
            if name.startswith(PREFIX) and number != WITHDRAWN
        }
        self._files = {
            name.removeprefix(FILES)
            for name, number in units.items()
            if name.startswith(FILES) and number != WITHDRAWN
        }

    def find(self, marks: Iterable[str]) -> frozenset[Origin]:
        """Return which files, and which drives of others, have the same marks."""
        return frozenset(
            _origin(number) for mark in marks if (number := self._numbers.get(mark)) is not None
        )

    def withdraw(self, origins: Collection[Origin], files: Collection[Origin]) -> list[Unit]:
        """Return what withdraws the marks of origins, and files themselves that are all gone."""
        of_drives = [
            name
            for name, number in self._numbers.items()
            if (origin := _origin(number)) in origins or origin.file in files
        ]
        of_files = [f"{FILES}{digest}" for digest in self._files if Origin.of(digest) in files]
        return [Unit(name, WITHDRAWN) for name in (*of_drives, *of_files)]


def _number(origin: Origin) -> int:
    kind = int(origin.drive != WHOLE_FILE) << _DRIVE_BITS
    return int(origin.digest, 16) << (_MARK_BITS + _DRIVE_BITS) | kind | origin.drive


def _origin(number: int) -> Origin:
    digest = number >> (_MARK_BITS + _DRIVE_BITS)
    return Origin(f"{digest:0{DIGEST_CHARACTERS}x}", number % 2**_DRIVE_BITS)
