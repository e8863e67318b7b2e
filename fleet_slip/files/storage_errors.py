"""Turns what fails below a data root into `StorageError`, with the next thing to do."""

import contextlib
import errno
import re
from collections.abc import Iterator

import pyarrow as pa
from deltalake.exceptions import DeltaError

from fleet_slip.errors import StorageError
from fleet_slip.files.object_errors import known_meaning, meaning_of


@contextlib.contextmanager
def storage_errors(path: object) -> Iterator[None]:
    """Turn failures of the file system, of an object store and of Delta into `StorageError`.

    `path` says where, as text.
    """
    try:
        yield
    except OSError as error:
        reason = meaning_of(error) if "://" in str(path) else _reason(error)
        raise StorageError(f"{path}: {reason}") from None
    except DeltaError as error:
        known = known_meaning(error) if "://" in str(path) else None
        reason = known or f"the Delta log cannot be used: {first_line(error)}"
        raise StorageError(f"{path}: {reason}") from None
    except pa.ArrowException as error:
        raise StorageError(f"{path}: not readable as Parquet: {first_line(error)}") from None


def _reason(error: OSError) -> str:
    advice = {
        errno.ENOSPC: "the disk is full. Free some space and run the same command again.",
        errno.EDQUOT: "the disk quota is used up. Free some space and run the command again.",
        errno.EACCES: "permission denied. Check the owner of the data root, or choose another.",
        errno.EPERM: "not permitted. Check the owner of the data root, or choose another.",
        errno.EROFS: "the file system is read-only. Choose a writable data root.",
        errno.ENOTDIR: "a part of the path is a file, not a folder. Choose another data root.",
        errno.EMFILE: "this process may have no more files open. Raise the limit: ulimit -n 1024",
        errno.EEXIST: "a file, or a link to nothing, is where a folder must be. Choose another "
        "data root.",
        errno.ELOOP: "the path is a loop of links. Choose another data root.",
        errno.ENAMETOOLONG: "the path is too long. Choose another data root.",
        errno.EIO: "the disk cannot be read or written (I/O error). Have it examined, then restore "
        "what is damaged from a backup: fleet-slip verify",
    }
    # The Delta library tells the number in its text only.
    stated = re.search(r"\(os error (\d+)\)", str(error))
    number = error.errno or (int(stated[1]) if stated else 0)
    return advice.get(number, _on_one_line(error))


_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message."""
    return str(error).strip().partition("\n")[0]


def _on_one_line(error: BaseException) -> str:
    text = _COLOUR.sub("", str(error)).replace("\N{DOWNWARDS ARROW WITH TIP RIGHTWARDS}", ":")
    return " ".join(text.split()).replace(" : ", ": ")
