"""Copies of logs on an object store, to be read as files of this machine are.

Every format is read where it can be sought in and mapped, so that a log is copied as a whole to
the temporary folder (`TMPDIR`) while it is read.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

from fleet_slip.errors import FleetSlipError, InputError
from fleet_slip.files.folder import StoredFile
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.ingest.logs.log_files import Log, StoredParts, require_inside, stored_parts

AT_ONCE = 16


class LocalCopies:
    """Copies of some logs, which are fetched at once and last as long as this is entered.

    Files of this machine are no copies.
    """

    def __init__(self, logs: Iterable[Log]) -> None:
        """Take the logs."""
        self._stored = [log for log in dict.fromkeys(logs) if not isinstance(log, Path)]
        self._copies: dict[Log, Future[Path]] = {}

    def __enter__(self) -> Self:
        """Begin to fetch."""
        if self._stored:
            with storage_errors("the temporary folder"):
                self._folder = TemporaryDirectory(prefix="fleet-slip-copies-")
            self._threads = ThreadPoolExecutor(AT_ONCE)
            for number, log in enumerate(self._stored):
                folder = Path(self._folder.name, str(number))
                self._copies[log] = self._threads.submit(_copy, log, folder)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Remove the copies."""
        if self._stored:
            self._threads.shutdown(cancel_futures=True)
            self._folder.cleanup()

    @contextmanager
    def of(self, log: Log) -> Iterator[Path]:
        """Give the file to read a log from; what is raised meanwhile names the log.

        Raises `InputError` for a log that is not there, or changed since it was found, and
        `StorageError`.
        """
        if isinstance(log, Path):
            require_inside(log)
            yield log
            return
        copy = self._copies[log].result()
        folder = str(Path(self._folder.name, str(self._stored.index(log))))
        try:
            yield copy
        except FleetSlipError as error:
            raise type(error)(str(error).replace(folder, _bucket_of(log))) from None


def _copy(log: StoredFile | StoredParts, folder: Path) -> Path:
    """Copy a log below a folder, under its path in the bucket: keys may be in its names."""
    from fleet_slip.files.object_inputs import copy_object, parse_url  # noqa: PLC0415 - an extra

    for part in stored_parts(log):
        if not {"", ".", ".."}.isdisjoint(part.path.split("/")):
            raise InputError(f"{part}: its name is no path in the bucket. Give it another.")
        copy_object(part, folder / part.path)
    return folder / (log.path if isinstance(log, StoredFile) else parse_url(log.url)[1])


def _bucket_of(log: Log) -> str:
    return "/".join(str(log).split("/")[:3])


@contextmanager
def local_copy(log: Log) -> Iterator[Path]:
    """Give the file to read one log from. Raises what `LocalCopies.of` raises."""
    with LocalCopies([log]) as copies, copies.of(log) as file:
        yield file
