"""Cars that are known not to be forgotten, so that nobody has to hash their names again.

    cleared/7.txt   a line of JSON: the entries of `forgotten/` with which the cars below were
                    compared, and the SHA-256 of what follows; then their names, one a line

A car is cleared of an entry if the entry forgot neither it nor a drive that it can send a message
of. The names are of cars that have Gram rows, where they stand anyway. Who forgets a car knows its
name: the others are cleared of that entry at once. What the file says is true whoever writes
meanwhile, because entries never change: who reads it asks for the entries first, and believes it if
it has them all. It can be deleted: names are then compared again, 40 ms each.
"""

import json
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass

from fleet_slip.canonical import sha256_of
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.files.documents import ATTEMPTS
from fleet_slip.files.folder import Folder
from fleet_slip.warehouse.audit import Audit, Forgettable

FOLDER = "cleared"

_FILE = re.compile(r"([1-9][0-9]{0,8})\.txt")
_NAME = re.compile(r"[A-Za-z0-9._-]{1,16}")
"""Other cars send no messages."""


@dataclass(frozen=True)
class Cleared:
    """Cars, and the numbers of the entries that they are cleared of."""

    entries: frozenset[int] = frozenset()
    names: frozenset[str] = frozenset()


@dataclass(frozen=True)
class ClearedCars:
    """The cleared cars of a data root."""

    root: Folder

    def read(self) -> Cleared | None:
        """Return them; None where none were kept, or the file is damaged."""
        return self._newest()[1]

    def add(self, cars: Cleared) -> None:
        """Add cars. Of entries that the others are not cleared of the larger part is kept."""

        def change(now: Cleared | None) -> Cleared | None:
            if now is None or now.entries == cars.entries:
                return Cleared(cars.entries, cars.names | (now.names if now else frozenset()))
            lag = now.entries < cars.entries and len(now.names) < len(cars.names)
            return cars if lag else None

        if cars.names:
            self._change(change)

    def forget(
        self, audit: Audit, subject: Forgettable, present: Callable[[], Collection[str]]
    ) -> None:
        """Clear all cars but one of the entries of a subject, which is that car or its drive.

        `present` returns the cars that have Gram rows: where nothing else was ever forgotten, all
        but the subject are cleared.
        """
        mine, asked = audit.begun(subject), audit.begun()

        def change(now: Cleared | None) -> Cleared | None:
            if now is None:
                if asked != mine:
                    return None
                now = Cleared(frozenset(), frozenset(filter(_NAME.fullmatch, present())))
            return Cleared(now.entries | mine, now.names - {subject.sender or ""})

        if mine:
            self._change(change)

    def keep(self, present: Callable[[], Collection[str]]) -> None:
        """Drop the names of cars that have no Gram rows any more."""
        self._change(lambda now: now and Cleared(now.entries, now.names.intersection(present())))

    def _change(self, change: Callable[[Cleared | None], Cleared | None]) -> None:
        """Replace the file by what a change makes of it, if that is another; delete older ones."""
        for _ in range(ATTEMPTS):
            number, now = self._newest()
            new = change(now)
            if new is None or new == now:
                break
            if self._folder.create(f"{number + 1}.txt", _rendered(new)):
                # A number is free again once its file was replaced: mine may be an older one.
                if self._numbers()[-1:] == [number + 1]:
                    break
                self._folder.delete(f"{number + 1}.txt")
        else:
            raise ConflictError(
                f"{self._folder}: too many writers at once. Run the same command again."
            )
        for number in self._numbers()[:-1]:
            self._folder.delete(f"{number}.txt")

    def _newest(self) -> tuple[int, Cleared | None]:
        while numbers := self._numbers():
            try:
                return numbers[-1], _parsed(self._folder.read(f"{numbers[-1]}.txt"))
            except StorageError:
                if self._numbers() == numbers:  # nobody replaced it meanwhile
                    raise
        return 0, None

    def _numbers(self) -> list[int]:
        found = map(_FILE.fullmatch, self._folder.names())
        return sorted(int(number[1]) for number in found if number)

    @property
    def _folder(self) -> Folder:
        return self.root / FOLDER


def _rendered(cars: Cleared) -> bytes:
    names = "\n".join(sorted(cars.names))
    head = json.dumps({"entries": sorted(cars.entries), "sha256": sha256_of(names)})
    return f"{head}\n{names}".encode()


def _parsed(content: bytes) -> Cleared | None:
    try:
        head, _, names = content.decode().partition("\n")
        said = json.loads(head)
        if said["sha256"] != sha256_of(names):
            return None
        return Cleared(frozenset(said["entries"]), frozenset(names.split("\n")) - {""})
    except (ValueError, KeyError, TypeError):
        return None
