"""Recognises a recording that is in the logs, by its file's bytes or by a drive's samples.

A mark is a unit of work beside that of its file, in the same commit: two processes that land the
same recording at once are in conflict, and one of them is told. Its name is a hash, of all bytes of
a file or of samples of a drive (`fleet_slip.warehouse.recordings.Spots`); its number says of which
content and drive:

    40 bits of the content's digest | 3 bits: marks of the drive | 20 bits of the drive's name

0 marks stand for the file itself. Names of cars and drives do not follow from it.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256

import numpy as np

from fleet_slip.delta import WITHDRAWN, Unit
from fleet_slip.ingest.logs.spool import Spool
from fleet_slip.warehouse.recordings import Hashes, Spots

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


class FileMarks:
    """What tells a file and its drives again.

    Attributes:
        units: that land with it.
    """

    def __init__(self, seen: Spool | None = None, key: str = "") -> None:
        """Begin without any; what is seen of drives is kept under a key."""
        self.units: dict[str, int] = {}
        self._seen, self._key = seen or Spool(), key

    @classmethod
    def of(cls, digest: str, content: str, seen: Spool) -> "FileMarks":
        """Return the mark of a file: its digest, and that of its bytes alone."""
        marks = cls(seen, digest)
        marks.units[f"{PREFIX}{content[:16]}"] = _number(Origin.of(digest), 0)
        return marks

    def add(self, drive_id: str, spots: Spots) -> None:
        """Add a drive of the file. Raises `InputError` if a temporary file has no room."""
        number = _number(Origin.of_drive(drive_id) or Origin.of(self._key), len(spots.kept))
        self.units.update((f"{PREFIX}{mark:016x}", number) for mark in spots.kept.tolist())
        self._seen.add(self._key, spots.seen.tobytes())

    def seen(self) -> Iterator[Hashes]:
        """Yield the hashes of all samples that may be known, of each drive."""
        for piece in self._seen.read(self._key):
            yield np.frombuffer(piece, np.uint64)


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
        names = [int(name.removeprefix(PREFIX), 16) for name in self._numbers]
        self._names = np.sort(np.array(names, dtype=np.uint64))

    def find(self, marks: FileMarks) -> frozenset[Origin]:
        """Return which files, and which drives of others, a file has again.

        A drive is there again where half of what was kept of it is.
        """
        content = next(iter(marks.units), None)
        found = {_origin(n)[0] for n in [self._numbers.get(content or "")] if n is not None}
        for seen in marks.seen():
            there = seen[np.isin(seen, self._names)].tolist()
            many = Counter(self._numbers[f"{PREFIX}{one:016x}"] for one in there)
            for number, times in many.items():
                origin, kept = _origin(number)
                if kept and 2 * times >= kept:
                    found.add(origin)
        return frozenset(found)

    def withdraw(self, origins: Collection[Origin], files: Collection[Origin]) -> list[Unit]:
        """Return what withdraws the marks of origins, and files themselves that are all gone."""
        of_drives = [
            name
            for name, number in self._numbers.items()
            if (origin := _origin(number)[0]) in origins or origin.file in files
        ]
        of_files = [f"{FILES}{digest}" for digest in self._files if Origin.of(digest) in files]
        return [Unit(name, WITHDRAWN) for name in (*of_drives, *of_files)]


def _number(origin: Origin, marks: int) -> int:
    digest = int(origin.digest, 16)
    return digest << (_MARK_BITS + _DRIVE_BITS) | marks << _DRIVE_BITS | origin.drive


def _origin(number: int) -> tuple[Origin, int]:
    digest = number >> (_MARK_BITS + _DRIVE_BITS)
    marks = number >> _DRIVE_BITS & (2**_MARK_BITS - 1)
    return Origin(f"{digest:0{DIGEST_CHARACTERS}x}", number % 2**_DRIVE_BITS), marks
