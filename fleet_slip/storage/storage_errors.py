"""Translation of failures of files, object stores, Delta and Parquet to `StorageError`."""

import contextlib
import errno
import re
from collections.abc import Iterator

from fleet_slip.errors import StorageError

_CREDENTIALS = (
    "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, "
    "GOOGLE_APPLICATION_CREDENTIALS, or AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY"
)

_MEANINGS: tuple[tuple[str, str], ...] = (
    (
        r"169\.254\.169\.254|computeMetadata|metadata\.google|Account must be specified|"
        r"CredentialsNotLoaded|no providers in chain|no credentials found in chain",
        f"there are no credentials. Set {_CREDENTIALS}. "
        'eval "$(aws configure export-credentials --format env)" sets those of a profile.',
    ),
    (
        r"NoSuchBucket|ContainerNotFound|[Tt]he specified bucket does not exist",
        "there is no such bucket. Make it, or choose another data root.",
    ),
    (
        r"InvalidAccessKeyId|SignatureDoesNotMatch|ExpiredToken|InvalidToken|InvalidSecurity|"
        r"AuthenticationFailed|RequestTimeTooSkewed|InvalidClientTokenId|401 Unauthorized",
        f"the store refuses the credentials. Check {_CREDENTIALS}, and the clock.",
    ),
    (
        r"AccessDenied|AuthorizationFailure|AuthorizationPermissionMismatch|403 Forbidden",
        "the credentials do not permit this. Reading needs the right to get and list objects, "
        "writing to put them, and compact and forget to delete them.",
    ),
    (
        r"scheme is not allowed|BadScheme",
        "the endpoint is http, not https. Where that is meant: export AWS_ALLOW_HTTP=true",
    ),
    (
        r"501 Not Implemented|NotImplemented",
        "the store does not know conditional writes (If-None-Match), without which several "
        "writers are not safe. Use a store that does.",
    ),
    (
        r"(?:429|50[0-9]) [A-Z]|SlowDown|InternalError",
        "the store answers with errors, after several attempts. Run the same command again.",
    ),
    (
        r"InvalidPath",
        "the name of an object there is no path: a part is empty, `.`, `..` or has a control "
        "character. Rename it.",
    ),
    (
        r"timed out|TimedOut|kind: Timeout",
        "the store does not answer in time, after several attempts. Check the network, and run "
        "the same command again.",
    ),
    (
        r"dns error|error sending request|[Cc]onnection|connect error|HTTP error",
        "the store cannot be reached. Check the network and the endpoint (AWS_ENDPOINT_URL).",
    ),
    (r"NoSuchKey|BlobNotFound|404 Not Found|not found", "there is no such object."),
)

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


def known_meaning(error: BaseException) -> str | None:
    """Return the meaning of a failure of an object store; None if unknown."""
    text = str(error)
    return next((meaning for pattern, meaning in _MEANINGS if re.search(pattern, text)), None)


def meaning_of(error: BaseException) -> str:
    """Return the meaning of a failure of an object store, in one line."""
    unknown = f"the store cannot be used ({type(error).__name__}). Run the same command again."
    return known_meaning(error) or unknown


class NoSuchObjectError(StorageError):
    """An object does not exist."""


@contextlib.contextmanager
def object_errors(where: str) -> Iterator[None]:
    """Translate the failures of an object store to `StorageError`."""
    from obstore.exceptions import BaseError

    try:
        yield
    except FileNotFoundError as error:
        raise NoSuchObjectError(f"{where}: {meaning_of(error)}") from None
    except (BaseError, OSError, ValueError) as error:
        raise StorageError(f"{where}: {meaning_of(error)}") from None


@contextlib.contextmanager
def storage_errors(path: object) -> Iterator[None]:
    """Translate failures of files, object stores, Delta and Parquet; `path` begins the message."""
    try:
        yield
    except OSError as error:
        reason = meaning_of(error) if "://" in str(path) else _reason(error)
        raise StorageError(f"{path}: {reason}") from None
    except Exception as error:
        library_reason = _library_reason(error, "://" in str(path))
        if library_reason is None:
            raise
        raise StorageError(f"{path}: {library_reason}") from None


def _library_reason(error: Exception, is_store: bool) -> str | None:
    """Return the reason of an error of the Delta library or of pyarrow; None of any other."""
    import pyarrow as pa
    from deltalake.exceptions import DeltaError

    if isinstance(error, DeltaError):
        meaning = known_meaning(error) if is_store else None
        return meaning or f"the Delta log cannot be used: {first_line(error)}"
    if isinstance(error, pa.ArrowException):
        return f"not readable as Parquet: {first_line(error)}"
    return None


def _reason(error: OSError) -> str:
    advice = {
        errno.ENOSPC: "the disk is full. Free some space and run the same command again.",
        errno.EDQUOT: "the disk quota is used up. Free some space and run the command again.",
        errno.EACCES: "permission denied. Check the owner of the folder, or choose another.",
        errno.EPERM: "not permitted. Check the owner of the folder, or choose another.",
        errno.EROFS: "the file system is read-only. Choose a writable folder.",
        errno.EISDIR: "a folder, not a file. Name a file.",
        errno.ENOTDIR: "a part of the path is a file, not a folder. Choose another path.",
        errno.EMFILE: "this process may have no more files open. Raise the limit: ulimit -n 1024",
        errno.EEXIST: "a file, or a link to nothing, is where a folder must be. Choose another "
        "path.",
        errno.ELOOP: "the path is a loop of links. Choose another path.",
        errno.ENAMETOOLONG: "the path is too long. Choose another path.",
        errno.EIO: "the disk cannot be read or written (I/O error). Have it examined, then restore "
        "what is damaged from a backup: fleet-slip verify",
    }
    # The Delta library has the number in its message only.
    stated = re.search(r"\(os error (\d+)\)", str(error))
    number = error.errno or (int(stated[1]) if stated else 0)
    return advice.get(number, _on_one_line(error))


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message."""
    return str(error).strip().partition("\n")[0]


def _on_one_line(error: BaseException) -> str:
    text = _COLOUR.sub("", str(error)).replace("\N{DOWNWARDS ARROW WITH TIP RIGHTWARDS}", ":")
    return " ".join(text.split()).replace(" : ", ": ")
