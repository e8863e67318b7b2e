"""DuckDB connections: opening, limits, errors, and checks of queries and predicates of users."""

from __future__ import annotations

import contextlib
import difflib
import functools
import json
import re
import resource
import threading
import time
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass
from hashlib import sha256
from typing import TYPE_CHECKING, Any, TypeVar

from fleet_slip.base import pluralize
from fleet_slip.catalog.signals import ALL_DRIVES, SCENARIO, TRAINING_DRIVES, SignalCatalog
from fleet_slip.config import load_toml
from fleet_slip.errors import (
    QueryGoesOnError,
    QuestionError,
    StorageError,
    printable,
)
from fleet_slip.resources import data_needed, folder, memory_bytes
from fleet_slip.storage.data_files import check_local_files, missing_file_error
from fleet_slip.storage.folder import SPILL_PREFIX, Folder

if TYPE_CHECKING:  # functions import it: it takes as long to start as all else of most commands
    import duckdb

SPILL_LIMIT = "20GB"
"""Maximum size of the files of one connection for queries that exceed the memory."""

LOOK_S = 0.1
"""Interval at which a waiting query checks for Ctrl-C."""

STUCK_S = 0.7
"""Time that a query may take to stop after Ctrl-C."""

Result = TypeVar("Result")


def sql_text(text: str | None) -> str:
    """Return a text as an SQL literal; NULL for None."""
    return "NULL" if text is None else "'" + text.replace("'", "''") + "'"


def open_database(
    *, reading: Folder | None = None, spill: bool = False, threads: int | None = None
) -> duckdb.DuckDBPyConnection:
    """Open an in-memory database. Data stays in Parquet, so that no lock can block a reader.

    It can read the files below the folder `reading`, and takes at most half of the memory of the
    process. With `spill`, larger queries use the disk; otherwise they fail.
    """
    import duckdb

    spill_folder = reading.spill / f"{SPILL_PREFIX}{uuid.uuid4().hex}" if reading and spill else ""
    config: dict[str, str | bool | int | float | list[str]] = {
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
        "memory_limit": f"{memory_bytes() // 2 // 2**20}MiB",
        "temp_directory": str(spill_folder),
        "max_temp_directory_size": SPILL_LIMIT,
    }
    if threads is not None:
        config["threads"] = threads
    database = duckdb.connect(":memory:", config=config)
    # In notebooks DuckDB prints a bar on stdout; without ipywidgets it refuses the setting.
    with contextlib.suppress(duckdb.InvalidInputException):
        database.execute("SET enable_progress_bar = false")
    if reading:
        reading.enable_reading(database)
        database.execute("CALL enable_logging('FileSystem')")  # see `reading_files`
    return database


@functools.cache
def _in_common() -> duckdb.DuckDBPyConnection:
    import duckdb

    return duckdb.connect(":memory:", config={"threads": 1, "enable_external_access": False})


def open_scratch() -> duckdb.DuckDBPyConnection:
    """Open a connection that reads no files; a new database would take 20 ms."""
    return _in_common().cursor()


def limit_memory() -> None:
    """Limit the process to three quarters of the memory: DuckDB limits no single value."""
    limit = max(memory_bytes() // 4 * 3, data_needed())
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard == resource.RLIM_INFINITY or limit < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def interruptible(database: duckdb.DuckDBPyConnection, work: Callable[[], Result]) -> Result:
    """Do work with a connection such that Ctrl-C ends it, also in the middle of an operator.

    DuckDB checks for interrupts between tasks only, and a recursive query is one task. It ignores
    an interrupt before the query begins, so interrupts are repeated until the work ends. A function
    is never interrupted: then `QueryGoesOnError` is raised after `STUCK_S`. Its thread does not
    delay the end of the process.
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
        # A signal ends no wait if a library has set a handler that restarts system calls.
        while not wait([answer], LOOK_S).done:
            pass
    except KeyboardInterrupt:
        stopped.set()
        deadline = time.monotonic() + STUCK_S
        while not answer.done():
            if time.monotonic() > deadline:
                raise QueryGoesOnError from None
            with contextlib.suppress(KeyboardInterrupt):
                database.interrupt()
                time.sleep(LOOK_S)
        raise
    return answer.result()


_INTERRUPTED = "Query interrupted"
"""Message of DuckDB's Python client after Ctrl-C."""

_DELETED = re.compile(r'"(.*)/\*\*/\*\.parquet"')
"""DuckDB names a file that was deleted after its view was created as a folder."""

RESTORE = "If a file is missing or damaged, restore it from a backup."


@contextlib.contextmanager
def database_errors(doing: str) -> Iterator[None]:
    """Translate DuckDB's errors to ours; `doing` begins the message.

    If results are read by batch, pyarrow raises `OSError` with DuckDB's message.
    """
    import duckdb

    try:
        yield
    except MemoryError:
        memory = f"{memory_bytes() // 2**20:,} MiB"
        raise StorageError(f"{doing} failed: out of memory ({memory}). {_LESS}") from None
    except UnicodeDecodeError:  # the message quotes bytes of a damaged file
        raise StorageError(f"{doing} failed: a file is damaged. {RESTORE}") from None
    except (duckdb.Error, OSError, RuntimeError) as error:
        translated = _translated(error, f"{doing} failed: {duckdb_message(error)}")
        if translated is None:
            raise
        raise translated from None


_LESS = "Select less at once."


def _translated(error: Exception, message: str) -> BaseException | None:
    """Return our error for one of DuckDB; None for one of another library."""
    import duckdb

    kind = str(error).partition(" Error:")[0]
    if kind in ("INTERRUPT", _INTERRUPTED):
        return KeyboardInterrupt()
    if kind == "Out of Memory":
        return StorageError(f"{message}. {_LESS}")
    if kind == "Permission" and (deleted := _DELETED.search(str(error))):
        return missing_file_error(deleted[1])
    # Damaged Parquet metadata are an error without a class.
    if kind in ("IO", "Invalid Input", "INTERNAL") or type(error) is duckdb.Error:
        return StorageError(f"{message}. {RESTORE}")
    if isinstance(error, duckdb.Error) or kind in ("Conversion", "Out of Range"):
        return QuestionError(message)
    return None


@contextlib.contextmanager
def reading_files(database: duckdb.DuckDBPyConnection, doing: str) -> Iterator[None]:
    """Translate DuckDB's errors, and raise `StorageError` if a query opened a damaged file.

    DuckDB's log lists the files that the queries of the connection opened. Each is compared with
    the checksum in its name, also after a failed query.
    """
    try:
        with database_errors(doing):
            yield
    except (StorageError, QuestionError):
        check_opened_files(database)
        raise
    check_opened_files(database)


def check_opened_files(database: duckdb.DuckDBPyConnection) -> None:
    """Raise `StorageError` if a file that a connection opened does not match its checksum."""
    with database_errors("listing the opened files"):
        opened = database.execute(_OPENED_FILES).fetchall()
    check_local_files(path for (path,) in opened if "://" not in path)


# Not `duckdb_logs_parsed`, which takes seven times as long and reads no quotes in paths.
_OPENED_FILES = """
SELECT DISTINCT regexp_extract(message, '^.*?"path":"(.*)","op":"OPEN"}$', 1, 's') AS path
FROM duckdb_logs() WHERE type = 'FileSystem' AND suffix(message, '"op":"OPEN"}') AND (
    current_setting('enable_external_access')
    OR list_contains(current_setting('allowed_paths'), path)
)
"""


def duckdb_message(error: BaseException) -> str:
    """Return DuckDB's message on one line, without the excerpt of the statement or its advice."""
    text = str(error).partition("\n\nLINE ")[0].partition("\n\nPossible solutions:")[0]
    if "Traceback (most recent call last)" in text:  # of Python that DuckDB called to read a file
        text = text.strip().rpartition("\n")[2].partition(": ")[2]
    return " ".join(text.split()).rstrip(".")


# SQL of users: queries that only read.
#
# The type of a statement is no proof. In DuckDB a common table expression of a SELECT can copy rows
# to a file or change a table, and table functions can run SQL from a string. So the parsed tree is
# searched, where neither comments nor quotes hide anything.

LONGEST_QUERY = 100_000
"""Characters of one query. Planning takes more than linear time in some of them."""

QUERY_NODES = frozenset({"SELECT_NODE", "SET_OPERATION_NODE", "RECURSIVE_CTE_NODE", "CTE_NODE"})
"""Nodes of a statement that read. Others, such as COPY_QUERY_NODE, write."""


def split_statements(database: duckdb.DuckDBPyConnection, text: str) -> list[str]:
    """Return the statements of a text; the text itself if it has none or is not valid SQL."""
    import duckdb

    if len(text) > LONGEST_QUERY:
        return [text]
    try:
        return [statement.query for statement in database.extract_statements(text)] or [text]
    except (UnicodeEncodeError, duckdb.Error):
        return [text]


def one_query(database: duckdb.DuckDBPyConnection, text: str) -> str:
    """Return the text if it is one statement that only reads. Raises `QuestionError`."""
    import duckdb

    if len(text) > LONGEST_QUERY:
        raise QuestionError(
            f"the query has {len(text):,} characters, at most {LONGEST_QUERY:,} are read."
        )
    try:
        text.encode()
        statements = database.extract_statements(text)
    except UnicodeEncodeError:
        raise QuestionError("not valid SQL: it is not Unicode text.") from None
    except duckdb.Error as error:
        raise QuestionError(f"not valid SQL: {duckdb_message(error)}") from None
    if len(statements) != 1:
        raise QuestionError(f"one SQL statement is expected, not {len(statements)}.")
    is_explain = statements[0].type == duckdb.StatementType.EXPLAIN
    _require_reading(database, _EXPLAIN.sub("", text) if is_explain else text)
    return text


_EXPLAIN = re.compile(r"^\s*EXPLAIN\s+(?:ANALYZE\s+)?(?:\([^()]*\)\s*(?=\S))?", re.IGNORECASE)
"""Matches the words and options before the explained statement; EXPLAIN ANALYZE runs that."""


def _require_reading(database: duckdb.DuckDBPyConnection, text: str) -> None:
    statement = "SELECT json_serialize_sql($text::VARCHAR)"
    [(serialised,)] = database.execute(statement, {"text": text}).fetchall()
    try:
        tree = json.loads(serialised)
    except RecursionError:
        raise QuestionError("the query is nested too deeply. Divide it into parts.") from None
    if tree["error"]:
        raise QuestionError(
            "only queries are allowed here (SELECT, WITH, DESCRIBE, SUMMARIZE, EXPLAIN; a PIVOT "
            "with IN)."
        )
    after_from: set[int] = set()
    for node in nodes_of(tree):
        kind = node.get("type")
        if not isinstance(kind, str):
            continue
        if kind.endswith("_NODE") and kind not in QUERY_NODES:
            raise QuestionError("the query would write: only reading is allowed here.")
        if kind == "VALUE_PARAMETER":
            raise QuestionError("the query has a parameter without a value.")
        if kind == "TABLE_FUNCTION":
            after_from.add(id(node["function"]))
        if "function_name" in node:
            _require_function(str(node["function_name"]).lower(), id(node) in after_from)


def _require_function(name: str, after_from: bool) -> None:
    table_functions = allowed_words()["table"]["functions"]
    if after_from and name not in table_functions:
        raise QuestionError(
            f"the function {printable(name)!r} cannot be called after FROM here. Functions: "
            f"{', '.join(sorted(table_functions))}."
        )
    if not after_from and name not in frozenset().union(*allowed_words()["query"].values()):
        raise QuestionError(
            f"the function {printable(name)!r} cannot be called here: only functions that compute "
            "a value of their arguments can."
        )


@functools.cache
def allowed_words() -> Mapping[str, Mapping[str, frozenset[str]]]:
    """Return what SQL of users may contain, by section and key of `warehouse/functions.toml`."""
    sections = load_toml(folder("warehouse") / "functions.toml")
    return {
        section: {key: frozenset(text.split()) for key, text in lists.items()}
        for section, lists in sections.items()
    }


Tree = Mapping[str, Any]
"""An expression as DuckDB's parser serialises it."""


def nodes_of(tree: Any) -> Iterator[Tree]:
    """Yield the objects of a parsed text, parents first."""
    pending = [tree]
    while pending:
        value = pending.pop()
        if isinstance(value, dict):
            yield value
            pending.extend(reversed(value.values()))
        elif isinstance(value, list):
            pending.extend(reversed(value))


# Predicates of users and manifests: SQL expressions on the columns of a drive or row.
#
# A predicate becomes part of statements that run unattended for years. So it is parsed by itself
# first. It must be one expression of permitted columns, constants, and deterministic operators and
# functions: no subquery, random number or clock. Statements contain the parser's output, not the
# user's text.

_POSITION_KEYS = frozenset({"query_location", "query_location_length"})

_QUERY = "SELECT 1 FROM drives WHERE "


@dataclass(frozen=True)
class Predicate:
    """A checked predicate; `parse_predicate` makes it.

    Attributes
    ----------
    text
        The user's text, for messages and manifests.
    sql
        The parser's output in parentheses, for statements.
    """

    text: str
    sql: str

    def __str__(self) -> str:
        """Return the user's text."""
        return self.text

    @property
    def quoted(self) -> str:
        """The text in quotes for messages, with the number of excluded drives, not their hashes."""
        cohort, excluded = _split_excluded(self.text)
        return f"{cohort!r}{excluded}"

    @property
    def columns(self) -> frozenset[str]:
        """The columns in it."""
        return columns_of(_expression(self.sql, self.text))

    def __and__(self, other: Predicate) -> Predicate:
        """Return the conjunction of two predicates."""
        conjunction = f"({self.sql} AND {other.sql})"
        return Predicate(conjunction, conjunction)


@contextlib.contextmanager
def guarded_query(database: duckdb.DuckDBPyConnection, predicate: Predicate) -> Iterator[None]:
    """Translate the errors of a query with a predicate."""
    doing = f"the cohort {predicate.quoted}"
    try:
        with reading_files(database, doing):
            yield
    except StorageError as error:
        if not str(error).startswith(f"{doing} failed: Invalid Input Error"):
            raise
        # All files are sound.
        text = str(error).replace(" failed: ", " cannot be evaluated: ", 1)
        raise QuestionError(text.removesuffix(f" {RESTORE}")) from None


def parse_predicate(
    signals: SignalCatalog, text: str | Predicate, columns: Collection[str] | None = None
) -> Predicate:
    """Parse a predicate on columns, by default those of drives. Raises `QuestionError`."""
    if isinstance(text, Predicate):
        return text
    return _parse_cached(text, frozenset(drive_columns(signals) if columns is None else columns))


def parse_cohort(
    signals: SignalCatalog, text: str | Predicate, columns: Collection[str] | None = None
) -> Predicate:
    """Parse the predicate of a cohort; exclude evaluation drives unless it refers to them.

    It refers to them if it contains the column `source` or the word scenario. Raises
    `QuestionError`.
    """
    predicate = parse_predicate(signals, text, columns)
    if "source" in predicate.columns or SCENARIO in predicate.sql:
        return predicate
    return Predicate(predicate.text, f"({predicate.sql} AND {TRAINING_DRIVES})")


def drive_columns(signals: SignalCatalog) -> tuple[str, ...]:
    """Return the columns of cohort predicates: a drive's metadata and its day."""
    return (*signals.drive, "day")


def row_columns(signals: SignalCatalog) -> tuple[str, ...]:
    """Return the columns of predicates on rows of the view `log`."""
    columns = (signal.column for signal in signals.signals.values())
    return (*drive_columns(signals), "tick", "time_s", *columns)


@functools.lru_cache(maxsize=256)
def _parse_cached(text: str, columns: frozenset[str]) -> Predicate:
    quoted = f"the predicate {printable(text[:200])!r}"
    if len(text) > LONGEST_QUERY:
        raise QuestionError(
            f"{quoted} … has {len(text):,} characters, at most {LONGEST_QUERY:,} are read."
        )
    try:
        tree = _expression(text, quoted)
        for node in nodes_of(tree):
            for problem in _problems(node, columns):
                raise QuestionError(f"{quoted} {problem}")
        sql = _deparse(tree)
        if sql is None or _normalized(_expression(sql, quoted)) != _normalized(tree):
            raise QuestionError(f"{quoted} is too complex. Simplify it.")
    except RecursionError:
        raise QuestionError(f"{quoted} is nested too deeply. Simplify it.") from None
    return Predicate(text, f"({sql})")


def _expression(text: str, quoted: str) -> Tree:
    """Return the parsed expression of a predicate, which must be one expression.

    It is parsed alone and in parentheses. A text that closes a parenthesis fails alone; a text that
    continues after the expression (LIMIT, UNION, a second statement) fails in parentheses.
    """
    alone, enclosed = _parse(f"{text}\n", quoted), _parse(f"(\n{text}\n)", quoted)
    template = _parse("true", quoted)
    if alone != enclosed or {**alone, "where_clause": None} != {**template, "where_clause": None}:
        raise QuestionError(f"{quoted} is not one SQL expression.")
    expression: Tree = alone["where_clause"]
    return expression


def _parse(text: str, quoted: str) -> Tree:
    import duckdb

    try:
        (serialised,) = _run_scratch("SELECT json_serialize_sql($text::VARCHAR)", _QUERY + text)
    except (UnicodeEncodeError, duckdb.Error) as error:
        raise QuestionError(f"{quoted} is not valid SQL: {duckdb_message(error)}.") from None
    answer = json.loads(serialised, object_hook=_without_positions)
    if answer["error"]:
        reason = " ".join(str(answer.get("error_message")).split())
        raise QuestionError(f"{quoted} is not valid SQL: {reason}.")
    if len(answer["statements"]) != 1:
        raise QuestionError(f"{quoted} is not one SQL expression.")
    node: Tree = answer["statements"][0]["node"]
    return node


def _without_positions(node: dict[str, Any]) -> dict[str, Any]:
    """Return a parsed node without positions in the text."""
    return {key: value for key, value in node.items() if key not in _POSITION_KEYS}


def _normalized(value: Any) -> Any:
    """Return a tree in which operators and the functions of the same name are equal."""
    if isinstance(value, dict):
        return {key: _normalized(child) for key, child in value.items() if key != "is_operator"}
    return [_normalized(child) for child in value] if isinstance(value, list) else value


def _deparse(tree: Tree) -> str | None:
    """Return the SQL of a parsed expression; None if the parser cannot write it."""
    import duckdb

    (template,) = _run_scratch("SELECT json_serialize_sql($text::VARCHAR)", f"{_QUERY}true")
    query = json.loads(template)
    query["statements"][0]["node"]["where_clause"] = tree
    try:
        (text,) = _run_scratch("SELECT json_deserialize_sql($text::JSON)", json.dumps(query))
    except duckdb.Error:
        return None
    text = str(text)
    return text.removeprefix(_QUERY) if text.startswith(_QUERY) else None


def _run_scratch(statement: str, text: str) -> tuple[Any, ...]:
    with open_scratch() as database:
        [row] = database.execute(statement, {"text": text}).fetchall()
    return tuple(row)


# Predicates that exclude drives by hash, as their names must not be stored.

HASH_CHARACTERS = 16


def hash_drive(model: str, drive_id: str) -> str:
    """Return `left(sha256('MODEL ' || drive_id), 16)`, which replaces a drive's name."""
    return sha256(f"{model} {drive_id}".encode()).hexdigest()[:HASH_CHARACTERS]


def without_drives(cohort: str, model: str, hashes: Iterable[str]) -> str:
    """Return a predicate that also excludes the drives of these hashes."""
    listed = ", ".join(f"'{digest}'" for digest in sorted(hashes))
    if not listed:
        return cohort
    return (
        f"({cohort}) AND left(sha256('{model} ' || drive_id), {HASH_CHARACTERS}) NOT IN ({listed})"
    )


_EXCLUDED = re.compile(
    r"\((.*)\) AND left\(sha256\('[^']*' \|\| drive_id\), \d+\) NOT IN \(([^()]*)\)", re.DOTALL
)


def with_all_drives(cohort: str) -> str:
    """Return a predicate as before `without_drives`."""
    return _split_excluded(cohort)[0]


def describe_cohort(cohort: str) -> str:
    """Return a cohort for display after a number of drives: ` of NAME`, ` where PREDICATE`.

    Contains the number of excluded drives, not their hashes.
    """
    predicate, excluded = _split_excluded(cohort)
    if predicate in (ALL_DRIVES, TRAINING_DRIVES):
        return excluded
    campaign = _CAMPAIGN.fullmatch(predicate)
    return (f" of {campaign[1]}" if campaign else f" where {predicate}") + excluded


_CAMPAIGN = re.compile(r"campaign = '([^']*)'")
"""Matches the cohort of a pipeline: the drives of one campaign or mapping."""


def _split_excluded(cohort: str) -> tuple[str, str]:
    """Return a predicate without its exclusions, and a text with the number of excluded drives."""
    number = 0
    while match := _EXCLUDED.fullmatch(cohort):
        cohort, number = match[1], number + 1 + match[2].count(",")
    return cohort, f", without {pluralize(number, 'faulty drive')}" if number else ""


# What a predicate may contain is listed in `warehouse/functions.toml`.


def columns_of(tree: Tree) -> frozenset[str]:
    """Return the columns that a valid expression reads."""
    return frozenset(
        name.lower()
        for node in nodes_of(tree)
        if node.get("class") == "COLUMN_REF"
        for name in node["column_names"]
    )


def _problems(node: Tree, columns: frozenset[str]) -> Iterator[str]:
    """Yield the violation of a node, as the end of a sentence on the predicate."""
    kind, allowed = node.get("class"), allowed_words()["predicate"]
    if kind is None:
        return
    if kind not in allowed["expressions"] or (
        kind == "OPERATOR" and node["type"] not in allowed["conditions"]
    ):
        construct = str(node["type"]).replace("_", " ").lower()
        yield f"may not contain {construct}. Columns, constants, operators and functions may."
    elif kind == "COLUMN_REF":
        names = node["column_names"]
        if len(names) > 1 or names[0].lower() not in columns:
            name = printable(".".join(map(str, names)))
            nearest = difflib.get_close_matches(name.lower(), columns, n=1)
            hint = f" Did you mean {nearest[0]}?" if nearest else ""
            yield f"has an unknown column {name!r}.{hint} Columns: {', '.join(sorted(columns))}."
    elif kind == "FUNCTION":
        name = str(node["function_name"]).lower()
        extras = (node["schema"], node["catalog"], node["filter"], node["distinct"])
        is_plain = not any((*extras, node["order_bys"]["orders"]))
        if not is_plain or name not in allowed["functions"] | allowed["operators"]:
            yield (
                f"calls {printable(name)!r}. A predicate must always mean the same, so it may "
                f"call only: {', '.join(sorted(allowed['functions']))}."
            )
    elif kind == "TYPE" and (node["type_name"].upper() not in allowed["types"] or node["schema"]):
        name = printable(node["type_name"])
        yield f"casts to {name!r}. It may cast to: {', '.join(sorted(allowed['types']))}."
