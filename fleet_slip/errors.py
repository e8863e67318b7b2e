"""Every error that a user can meet, each with its exit code. The CLI maps them in one place."""

import re

INTERRUPTED = 130
"""Exit code after Ctrl-C."""

_LACK = re.compile(
    r"failed to map segment|cannot allocate memory|can't start new thread|bad allocation|"
    r"realloc of size|malloc of size",
    re.IGNORECASE,
)


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error is a want of memory, as Python, the loader and libraries tell it."""
    return isinstance(error, MemoryError) or _LACK.search(str(error)) is not None


HIDDEN = "***"

_URL, _WHOLE_URL = re.compile(r"://([^\s'\"]+)"), re.compile(r"(?s)://(.+)")
_SECRET = re.compile(
    r"(?i)([?&][\w.-]*(?:key|token|secret|passw|sig|credential)[\w.-]*=)[^&\s'\"]+"
)


def hide_passwords(text: str, *, to_end: bool = False) -> str:
    """Return text without users and queries of URLs; with `to_end`, a URL goes on to the end."""
    if "://" not in text:
        return text
    url = _WHOLE_URL if to_end else _URL
    return _SECRET.sub(rf"\1{HIDDEN}", url.sub(_without_user, text))


def _without_user(match: re.Match[str]) -> str:
    user, at, host = match[1].rpartition("@")  # a password may have @ and / in it
    secret = at and (":" in user or "/" not in user)
    return f"://{HIDDEN}@{host}" if secret else match[0]


def printable(text: str) -> str:
    """Return text on one line, for a terminal or a log: the unprintable as escapes like `\x1b`.

    A name from outside may hold line breaks, which forge lines, or escape sequences.
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


class FleetSlipError(Exception):
    """Base of all expected errors: the message says what, where, and what to do next."""

    exit_code = 1
    headline = ""
    """What a command ends with instead, where it has printed the rest before."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(hide_passwords(message)))


class UsageError(FleetSlipError):
    """What is asked for means nothing: a value out of range, options that exclude each other."""

    exit_code = 2


class ConfigError(FleetSlipError):
    """A file in `configs/`, or one given by the user, does not say what it must."""

    exit_code = 3


class InputError(FleetSlipError):
    """Data from outside is missing, unreadable or not what its mapping says."""

    exit_code = 4


class RepeatedError(InputError):
    """A recording that is in the logs already: a second time it would count twice."""

    exit_code = 15


class DataError(FleetSlipError):
    """The data cannot answer: an empty cohort, an absent signal, a rank-deficient model."""

    exit_code = 5


class NotComputedError(DataError):
    """A cohort has drives, and none has the Gram rows of a feature set, or not all have them."""


class QuestionError(FleetSlipError):
    """The question has no answer: bad SQL, an unknown model, signal, feature set or ranking."""

    exit_code = 5


class StorageError(FleetSlipError):
    """The data root cannot be read or written: permissions, a full disk, a damaged file."""

    exit_code = 6


class RefusedError(FleetSlipError):
    """The request is understood and would do harm: a worse model, a changed campaign."""

    exit_code = 7


class ConflictError(FleetSlipError):
    """Another process changed the same thing at the same time, and retrying did not help."""

    exit_code = 8


class DamageError(FleetSlipError):
    """`verify` found damage, and did not or could not repair all of it."""

    exit_code = 9


class AlarmError(FleetSlipError):
    """The answer calls for attention: stale data, a failed run, a faulty sensor, drift."""

    exit_code = 10


class PendingError(FleetSlipError):
    """What was asked for is not all done yet; what is left has to wait for other jobs to end."""

    exit_code = 12


class ClusterError(FleetSlipError):
    """The cluster cannot be reached or used, or its workers died of a task."""

    exit_code = 11


class NotScreenedError(FleetSlipError):
    """What is to train a model could not be examined first."""

    exit_code = 16


class ExtraError(FleetSlipError):
    """A package that only some commands need is not installed."""

    exit_code = 13


class QueryGoesOnError(KeyboardInterrupt):
    """Ctrl-C was pressed in the middle of what DuckDB cannot stop: it goes on in a thread."""
