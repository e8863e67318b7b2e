"""All expected errors, with their exit codes."""

import re

INTERRUPTED = 130
"""Exit code after Ctrl-C."""

_LACK = re.compile(
    r"failed to map segment|cannot allocate memory|can't start new thread|bad allocation|"
    r"realloc of size|malloc of size",
    re.IGNORECASE,
)


def is_lack_of_memory(error: BaseException) -> bool:
    """Return True for a lack of memory, reported by Python, the loader or a library."""
    return isinstance(error, MemoryError) or _LACK.search(str(error)) is not None


HIDDEN = "***"

_URL, _WHOLE_URL = re.compile(r"://([^\s'\"]+)"), re.compile(r"(?s)://(.+)")
_SECRET = re.compile(
    r"(?i)([?&][\w.-]*(?:key|token|secret|passw|sig|credential)[\w.-]*=)[^&\s'\"]+"
)


def hide_passwords(text: str, *, to_end: bool = False) -> str:
    """Replace secrets in URLs by asterisks; with `to_end`, a URL extends to the end of the text."""
    if "://" not in text:
        return text
    url = _WHOLE_URL if to_end else _URL
    return _SECRET.sub(rf"\1{HIDDEN}", url.sub(_without_user, text))


def _without_user(match: re.Match[str]) -> str:
    user, at, host = match[1].rpartition("@")  # a password may have @ and / in it
    secret = at and (":" in user or "/" not in user)
    return f"://{HIDDEN}@{host}" if secret else match[0]


def printable(text: str) -> str:
    r"""Return text on one line for a terminal or log, with escapes such as `\x1b`.

    Names from outside may contain line breaks, which forge lines, or escape sequences.
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


class FleetSlipError(Exception):
    """Base of all expected errors. Messages state what happened, where, and what to do next."""

    exit_code = 1
    headline = ""
    """Last line of a command that has printed the message before; empty for the message itself."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(hide_passwords(message)))


class UsageError(FleetSlipError):
    """Invalid arguments: a value out of range, options that exclude each other."""

    exit_code = 2


class ConfigError(FleetSlipError):
    """An invalid configuration file."""

    exit_code = 3


class InputError(FleetSlipError):
    """A log file is missing, unreadable, or does not match its mapping."""

    exit_code = 4


class MissingColumnError(InputError):
    """A log file lacks a column of its mapping."""


class RepeatedError(InputError):
    """A recording that the logs already contain."""

    exit_code = 15


class DataError(FleetSlipError):
    """The data do not suffice: an empty cohort, an absent signal, a rank-deficient model."""

    exit_code = 5


class NotComputedError(DataError):
    """Drives of a cohort lack the Gram rows of a feature set."""


class QuestionError(FleetSlipError):
    """An invalid query: bad SQL, an unknown model, signal, feature set or ranking."""

    exit_code = 5


class StorageError(FleetSlipError):
    """The data root cannot be read or written: permissions, a full disk, a damaged file."""

    exit_code = 6


class RefusedError(FleetSlipError):
    """A valid request that would do harm: a worse model, a changed campaign."""

    exit_code = 7


class ConflictError(FleetSlipError):
    """Another process changed the same thing at the same time, and retrying did not help."""

    exit_code = 8


class DamageError(FleetSlipError):
    """`verify` found damage that is not repaired."""

    exit_code = 9


class AlarmError(FleetSlipError):
    """The result requires attention: stale data, a failed run, a faulty sensor, drift."""

    exit_code = 10


class PendingError(FleetSlipError):
    """A part of the work must wait until other jobs end."""

    exit_code = 12


class ClusterError(FleetSlipError):
    """The cluster cannot be reached or used, or a task killed its workers."""

    exit_code = 11


class NotScreenedError(FleetSlipError):
    """Training drives could not be screened for faulty sensors."""

    exit_code = 16


class ExtraError(FleetSlipError):
    """A package that only some commands need is not installed."""

    exit_code = 13


class QueryGoesOnError(KeyboardInterrupt):
    """Ctrl-C during a query that DuckDB cannot stop; it continues in a thread."""
