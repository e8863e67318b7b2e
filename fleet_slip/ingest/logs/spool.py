"""Keeps what comes in one order and is read in another, in a temporary file if it is large.

The file has no name: it is gone with the process, however that ends.
"""

import errno
import tempfile
from collections import defaultdict
from collections.abc import Hashable, Iterator
from contextlib import contextmanager

from fleet_slip.errors import InputError

IN_MEMORY_BYTES = 2**24
"""Up to this size all is in memory, and there is no file."""


@contextmanager
def needing_room(written: int) -> Iterator[None]:
    """Raise `InputError` where a temporary file, so long already, cannot be written."""
    try:
        yield
    except OSError as error:
        if error.errno == errno.EFBIG:  # a limit of our own, on a file that unfolds
            raise
        raise InputError(
            f"{tempfile.gettempdir()}: no room for a temporary copy of more than {written:,} bytes "
            f"({error.strerror}). Free some, or name another folder in the environment variable "
            "TMPDIR."
        ) from None


class Spool:
    """Pieces of bytes by key, those of a key in the order in which they came."""

    def __init__(self) -> None:
        """Begin without any."""
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES)  # noqa: SIM115 - see close
        self._pieces: dict[Hashable, list[tuple[int, int]]] = defaultdict(list)
        self._end = 0

    def add(self, key: Hashable, piece: bytes) -> None:
        """Keep a piece. Raises `InputError` if the disk is full."""
        with needing_room(self._end):
            self._file.seek(self._end)
            self._file.write(piece)
            self._file.flush()
        self._pieces[key].append((self._end, len(piece)))
        self._end += len(piece)

    def read(self, key: Hashable) -> Iterator[bytes]:
        """Yield the pieces of a key."""
        for start, size in self._pieces[key]:
            self._file.seek(start)
            yield self._file.read(size)

    def clear(self) -> None:
        """Forget all pieces."""
        self._pieces.clear()
        self._file.seek(0)
        self._file.truncate()
        self._end = 0

    def close(self) -> None:
        """Let go of all."""
        self._file.close()
