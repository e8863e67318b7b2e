"""DuckDB connections: how they are opened, what they may use, and how their errors are told."""

import contextlib
import resource
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from typing import TypeVar

import duckdb

from fleet_slip.errors import FleetSlipError, QueryGoesOnError, QuestionError, StorageError
from fleet_slip.files.checksums import check_local_files
from fleet_slip.files.folder import Folder
from fleet_slip.limits import data_needed, memory_bytes

SPILL_LIMIT = "20GB"
"""Largest size of what one connection may write to disk for a query beyond its memory."""

LOOK_S = 0.1
"""How often a waiting query looks whether Ctrl-C was pressed."""

STUCK_S = 0.7
"""So long after a Ctrl-C a query may take to stop."""

Result = TypeVar("Result")


def sql_text(text: str | None) -> str:
    """Return a text as SQL has it, in quotes; NULL for none."""
    return "NULL" if text is None else "'" + text.replace("'", "''") + "'"


def open_database(
    *, reading: Folder | None = None, spill: bool = False, threads: int | None = None
) -> duckdb.DuckDBPyConnection:
    """Open an in-memory database. Data stays in Parquet, so that no lock can block a reader.

    It can read the files below the folder `reading`. It takes at most half of the memory that the
    process may have. What a large query cannot hold in memory goes to disk if it may `spill`;
    otherwise such a query fails.
    """
    aside = reading.spill / f".spill-{uuid.uuid4().hex}" if reading and spill else ""
    config: dict[str, str | bool | int | float | list[str]] = {
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
        "memory_limit": f"{memory_bytes() // 2 // 2**20}MiB",
        "temp_directory": str(aside),
        "max_temp_directory_size": SPILL_LIMIT,
    }
    if threads is not None:
        config["threads"] = threads
    database = duckdb.connect(":memory:", config=config)
    # Where no script is running, in a notebook say, DuckDB prints a bar on stdout. In a notebook
    # without ipywidgets it has none, and refuses the setting.
    with contextlib.suppress(duckdb.InvalidInputException):
        database.execute("SET enable_progress_bar = false")
    if reading:
        reading.let_read(database)
        database.execute("CALL enable_logging('FileSystem')")  # see `reading_files`
    return database


def limit_memory() -> None:
    """Let the process have three quarters of the memory: DuckDB bounds no single value."""
    limit = max(memory_bytes() // 4 * 3, data_needed())
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard == resource.RLIM_INFINITY or limit < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def interruptible(database: duckdb.DuckDBPyConnection, work: Callable[[], Result]) -> Result:
    """Do work with a connection so that Ctrl-C ends it, in the middle of an operator, too.

    DuckDB asks whether to stop between tasks only, and a recursive query is one task. It forgets an
    interruption that comes before the query begins, so that it is told again until the work ends.
    It never stops in the middle of a function: then `QueryGoesOnError` is raised after `STUCK_S`,
    while the work goes on, in a thread that the end of the process does not wait for.
    """
    answer: Future[Result] = Future()
    stopped = threading.Event()

    def unless_stopped() -> None:
        try:
            if not stopped.is_set():
                answer.set_result(work())
            else:
                answer.cancel()
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=unless_stopped, daemon=True).start()
    try:
        # Where a library has set a handler that restarts system calls, a signal ends no wait.
        while not wait([answer], LOOK_S).done:
            pass
    except KeyboardInterrupt:
        stopped.set()
        until = time.monotonic() + STUCK_S
        while not answer.done():
            if time.monotonic() > until:
                raise QueryGoesOnError from None
            with contextlib.suppress(KeyboardInterrupt):
                database.interrupt()
                time.sleep(LOOK_S)
        raise
    return answer.result()


_INTERRUPTED = "Query interrupted"
"""What DuckDB's Python client says when it stopped at a Ctrl-C."""

_OF_FILES = (
    duckdb.IOException,
    duckdb.InvalidInputException,
    duckdb.InternalException,
)


_STREAMED: dict[str, type[Exception]] = {
    "Conversion Error": duckdb.ConversionException,
    "Out of Range Error": duckdb.OutOfRangeException,
    "Invalid Input Error": duckdb.InvalidInputException,
    "IO Error": duckdb.IOException,
    "INTERNAL Error": duckdb.InternalException,
    "Out of Memory Error": duckdb.OutOfMemoryException,
    "INTERRUPT Error": duckdb.InterruptException,
}


@contextlib.contextmanager
def _errors_of_streams() -> Iterator[None]:
    """Raise what DuckDB raised: of an answer that is read batch by batch, pyarrow hides it."""
    try:
        yield
    except OSError as error:
        kind = _STREAMED.get(str(error).partition(":")[0])
        if kind is None:
            raise
        raise kind(str(error)) from None


@contextlib.contextmanager
def database_errors(doing: str) -> Iterator[None]:
    """Turn DuckDB's errors into ours, saying what was being done."""
    try:
        with _errors_of_streams():
            yield
    except FleetSlipError:
        raise
    except duckdb.InterruptException:
        raise KeyboardInterrupt from None
    except RuntimeError as error:
        if str(error) == _INTERRUPTED:
            raise KeyboardInterrupt from None
        raise
    except (duckdb.OutOfMemoryException, MemoryError) as error:
        reason = duckdb_message(error) or f"out of memory ({memory_bytes() // 2**20:,} MiB)"
        raise StorageError(f"{doing} failed: {reason}. Ask for less at once.") from None
    except _OF_FILES as error:
        raise StorageError(f"{doing} failed: {duckdb_message(error)}. {_RESTORE}") from None
    except duckdb.Error as error:
        if type(error) is duckdb.Error:  # what its Parquet reader raises at damaged metadata
            raise StorageError(f"{doing} failed: {duckdb_message(error)}. {_RESTORE}") from None
        raise QuestionError(f"{doing} failed: {duckdb_message(error)}") from None
    except UnicodeDecodeError:  # the message quotes bytes of a damaged file
        raise StorageError(f"{doing} failed: a file is damaged. {_RESTORE}") from None


@contextlib.contextmanager
def reading_files(database: duckdb.DuckDBPyConnection, doing: str) -> Iterator[None]:
    """Turn DuckDB's errors into ours, and let nothing pass that came from a damaged file.

    DuckDB's own log tells which files the queries of the connection have opened; each is compared
    with the checksum in its name, whatever came of the query.
    """
    try:
        with database_errors(doing):
            yield
    except (StorageError, QuestionError):
        check_opened_files(database)
        raise
    check_opened_files(database)


def check_opened_files(database: duckdb.DuckDBPyConnection) -> None:
    """Raise `StorageError` if a file that a connection has opened is not what its name says."""
    with database_errors("asking which files were read"):
        opened = database.execute(_OPENED_FILES).fetchall()
    check_local_files(path for (path,) in opened if "://" not in path)


_OPENED_FILES = "SELECT DISTINCT path FROM duckdb_logs_parsed('FileSystem') WHERE op = 'OPEN'"


def duckdb_message(error: BaseException) -> str:
    """Return DuckDB's message on one line, without the excerpt of the statement or its advice."""
    text = str(error).partition("\n\nLINE ")[0].partition("\n\nPossible solutions:")[0]
    if "Traceback (most recent call last)" in text:  # of Python that DuckDB called to read a file
        text = text.strip().rpartition("\n")[2].partition(": ")[2]
    return " ".join(text.split()).rstrip(".")


_RESTORE = "If a file is missing or damaged, restore it from a backup."
