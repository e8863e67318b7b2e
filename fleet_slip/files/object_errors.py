"""What an object store's answers mean, in one line, and what to do next.

The libraries tell only in text what went wrong, with the server's whole answer in it; that has
names of keys and is never shown.
"""

import contextlib
import re
from collections.abc import Iterator

from fleet_slip.errors import StorageError

_CREDENTIALS = (
    "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY or AWS_PROFILE, "
    "GOOGLE_APPLICATION_CREDENTIALS, or AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY"
)

_TIMEOUT = r"timed out|TimedOut|kind: Timeout"

_MEANINGS: tuple[tuple[str, str], ...] = (
    (
        r"169\.254\.169\.254|computeMetadata|metadata\.google|Account must be specified|"
        r"CredentialsNotLoaded|no providers in chain|no credentials found in chain",
        f"there are no credentials. Set {_CREDENTIALS}.",
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
        "writing to put them, and vacuum and forget to delete them.",
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
        "the name of an object there is no path: a part of it is empty, `.` or `..`. Rename it.",
    ),
    (
        _TIMEOUT,
        "the store does not answer in time, after several attempts. Check the network, and run "
        "the same command again.",
    ),
    (
        r"dns error|error sending request|[Cc]onnection|connect error|HTTP error",
        "the store cannot be reached. Check the network and the endpoint (AWS_ENDPOINT_URL).",
    ),
    (r"NoSuchKey|BlobNotFound|404 Not Found|not found", "there is no such object."),
)


def known_meaning(error: BaseException) -> str | None:
    """Return what a failure of an object store means, in one line; None if it is not known."""
    text = str(error)
    return next((meaning for pattern, meaning in _MEANINGS if re.search(pattern, text)), None)


def is_timeout(error: BaseException) -> bool:
    """Whether a request was given up because an answer did not come in time."""
    return re.search(_TIMEOUT, str(error)) is not None


def meaning_of(error: BaseException) -> str:
    """Return what a failure of an object store means, in one line."""
    unknown = f"the store cannot be used ({type(error).__name__}). Run the same command again."
    return known_meaning(error) or unknown


class NoSuchObjectError(StorageError):
    """An object is not there, or is gone."""


@contextlib.contextmanager
def object_errors(where: str) -> Iterator[None]:
    """Turn the failures of an object store into `StorageError`."""
    from obstore.exceptions import BaseError  # noqa: PLC0415 - the library is optional

    try:
        yield
    except FileNotFoundError as error:
        raise NoSuchObjectError(f"{where}: {meaning_of(error)}") from None
    except (BaseError, OSError, ValueError) as error:
        raise StorageError(f"{where}: {meaning_of(error)}") from None
