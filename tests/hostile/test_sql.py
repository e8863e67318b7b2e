"""SQL of strangers reads the warehouse and does nothing else."""

import contextlib
import hashlib
import json
import os
import resource
import signal
import threading
from pathlib import Path
from tempfile import TemporaryDirectory

import duckdb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.base import no_progress
from fleet_slip.errors import QuestionError, StorageError
from fleet_slip.grams.update import update_grams
from fleet_slip.storage.data_files import check_local_files
from fleet_slip.storage.local import LocalFolder
from fleet_slip.views import connect
from fleet_slip.warehouse.database import (
    allowed_words,
    check_opened_files,
    database_errors,
    interruptible,
    one_query,
)
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import RunCommand
from tests.support.logs import land, log_rows, path_of, random_counts


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A warehouse of one file with two drives."""
    warehouse = Warehouse(LocalFolder(tmp_path_factory.mktemp("sql") / "data"))
    rng = np.random.default_rng(1)
    land(warehouse, "one", *(log_rows(f"d{i}", random_counts(rng, 50)) for i in range(2)))
    update_grams(warehouse, no_progress)
    return path_of(warehouse.root)


def contents(folder: Path) -> dict[str, str]:
    """Every file below a folder with its checksum."""
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def serialised(query: str) -> str:
    """The query as DuckDB's JSON, to be run from a string."""
    row = duckdb.execute("SELECT json_serialize_sql($q::VARCHAR)", {"q": query}).fetchone()
    assert row is not None
    return str(row[0]).replace("'", "''")


COPY_IN_CTE = "WITH x AS (COPY (SELECT 1) TO '{file}' (USE_TMP_FILE false)) FROM x"

WRITES = [
    "COPY (SELECT 1) TO '{file}'",
    "/* hidden */ EXPLAIN ANALYZE COPY (SELECT 1) TO '{file}'",
    "EXPLAIN /* hidden */ (ANALYZE) COPY (SELECT 1) TO '{file}'",
    "EXPLAIN (ANALYZE, FORMAT json) COPY (SELECT 1) TO '{file}'",
    COPY_IN_CTE,
    "EXPLAIN (ANALYZE) (" + COPY_IN_CTE + ")",
    "WITH x AS (DELETE FROM dictionary RETURNING *) FROM x",
    "EXPORT DATABASE '{file}'",
    "PREPARE p AS COPY (SELECT 1) TO '{file}'",
    "SELECT 1; COPY (SELECT 1) TO '{file}'",
    "SET VARIABLE log_files = ['/etc/passwd']",
    "ATTACH '{file}'",
    "CREATE TABLE t AS SELECT 1",
    "CALL enable_logging(storage := 'file', storage_path := '{file}')",
    "FROM enable_logging(storage := 'file', storage_path := '{file}')",
    "FROM query('COPY (SELECT 1) TO ''{file}''')",
    "FROM system.main.\"QUERY\"('SELECT 1')",
    "PRAGMA enable_profiling",
    "LOAD json",
]


IN_STRINGS = (
    "FROM json_execute_serialized_sql('{text}')",
    "SELECT (SELECT 1 FROM json_execute_serialized_sql('{text}'))",
    "EXPLAIN SELECT * FROM \"json_execute_serialized_sql\"('{text}')",
)


def test_statements_that_write_are_refused_and_not_run(root: Path) -> None:
    before = contents(root)
    target = root / next(name for name in before if name.endswith(".parquet"))
    text = serialised(COPY_IN_CTE.format(file=target))
    answered = []
    with connect(root) as database:
        for attack in (*WRITES, *IN_STRINGS):
            with contextlib.suppress(QuestionError):
                answered.append(one_query(database, attack.format(file=target, text=text)))
    assert answered == []
    assert contents(root) == before


UNLISTED = {
    "SELECT write_log('x', log_type := 'FileSystem')": "write_log",
    "SELECT list_transform([1], lambda x: sleep_ms(x))": "sleep_ms",
    "SELECT sum(1) OVER (ORDER BY nextval('x'))": "nextval",
    "EXPLAIN ANALYZE SELECT pg_sleep(1)": "pg_sleep",
    "SELECT current_setting('home_directory')": "current_setting",
    "FROM duckdb_logs()": "duckdb_logs",
    "FROM read_text('/etc/passwd')": "read_text",
}


@pytest.mark.parametrize("query", UNLISTED)
def test_a_function_that_is_not_listed_is_refused_by_name(query: str) -> None:
    with (
        duckdb.connect() as database,
        pytest.raises(QuestionError, match=f"function '{UNLISTED[query]}' cannot be called"),
    ):
        one_query(database, query)


def test_listed_functions_are_those_of_duckdb_that_only_compute() -> None:
    with duckdb.connect() as database:
        query = "SELECT function_name, stability FROM duckdb_functions()"
        functions = database.execute(query).fetchall()
    names = {name.lower() for name, _ in functions}
    allowed = allowed_words()
    assert names >= allowed["table"]["functions"]
    callable_in_queries = frozenset().union(*allowed["query"].values())
    assert callable_in_queries - names == {"ifnull", "nvl"}  # which its parser replaces
    acting = {name for name, stability in functions if stability == "VOLATILE"}
    assert acting & callable_in_queries == {"error", "random"}


def test_a_forged_log_of_opened_files_opens_no_pipe(root: Path, tmp_path: Path) -> None:
    names = [tmp_path / f"{kind}-x{'0' * 16}-{'0' * 32}.parquet" for kind in ("pipe", "file")]
    os.mkfifo(names[0])
    names[1].write_text("not the content that the name states")
    with connect(root, query="log") as database:
        for name in names:
            message = f'{{"fs":"LocalFileSystem","path":"{name}","op":"OPEN"}}'
            database.execute("SELECT write_log($m, log_type := 'FileSystem')", {"m": message})
        check_opened_files(database)
    with pytest.raises(StorageError, match="not a regular file"):
        check_local_files([str(names[0])])


READS = (
    "FROM drives",
    "EXPLAIN SELECT 1",
    "EXPLAIN (SELECT 1)",
    "EXPLAIN ANALYZE FROM drives",
    "EXPLAIN (ANALYZE, FORMAT json) SELECT 1",
    "DESCRIBE log",
    "WITH a AS (SELECT 1 AS n) SELECT (SELECT max(n) FROM a) FROM range(3)",
    "WITH RECURSIVE r AS (SELECT 1 AS n UNION ALL SELECT n + 1 FROM r WHERE n < 5) FROM r",
    "PIVOT drives ON source IN ('simulated') USING count(*)",
    "SELECT view, count(*) FROM dictionary GROUP BY ALL UNION ALL SELECT 'all', 1",
    "SELECT copy, insert FROM (SELECT 1 AS copy, 2 AS insert)",
    "FROM duckdb_columns() WHERE NOT internal",
    "SELECT [n + 1 for n in [1, 2] if n > 1], {'a': 1}.a, MAP {'a': 1}['a'], 'abc'[1:2]",
    "SELECT DATE '2024-05-31' + INTERVAL 3 DAY, EXTRACT(day FROM now()), 2 ** 3, 3!, 'a' ~ 'b'",
    "SELECT 'a' SIMILAR TO 'b', position('a' IN 'b'), trim(both 'x' FROM 'y'), ifnull(NULL, 1)",
    "SELECT quantile_cont(n, 0.5), mode() WITHIN GROUP (ORDER BY n) FROM range(3) t(n)",
    "SELECT rank() OVER (ORDER BY n), sum(n) FILTER (n > 1) OVER () FROM range(3) t(n)",
)


def test_statements_that_read_are_answered(root: Path) -> None:
    with connect(root) as database:
        for query in READS:
            assert database.sql(one_query(database, query)).fetchall() is not None, query


BEFORE = (
    *("EXPLAIN ", "EXPLAIN ANALYZE ", "EXPLAIN (ANALYZE) "),
    *("/* x */ ", "-- x\n", "(", "WITH x AS ("),
)
WITHIN = (
    *("SELECT 1", "FROM t", "SUMMARIZE t", "FROM query('FROM t')", "COPY (FROM t) TO 'f'"),
    *("COPY t FROM 'f'", "INSERT INTO t VALUES (2)", "DELETE FROM t RETURNING *", "DROP TABLE t"),
    *("EXPORT DATABASE 'f'", "ATTACH 'f'", "UPDATE t SET n = 2 RETURNING n"),
    "CREATE VIEW v AS FROM t",
)
AFTER = (")", ") FROM x", ";", "; DELETE FROM t", " UNION ALL FROM t", " /* x", " -- x", "\0")


@settings(max_examples=100)
@given(
    st.builds(
        "{}{}{}".format,
        st.lists(st.sampled_from(BEFORE), max_size=3).map("".join),
        st.sampled_from(WITHIN) | st.text(max_size=12),
        st.lists(st.sampled_from(AFTER), max_size=3).map("".join),
    )
)
def test_accepted_statements_write_nothing(text: str) -> None:
    with TemporaryDirectory() as folder, contextlib.chdir(folder), duckdb.connect() as database:
        database.execute("CREATE TABLE t AS SELECT 1 AS n")
        try:
            query = one_query(database, text)
        except QuestionError as error:
            assert str(error).isprintable()
            return
        with contextlib.suppress(duckdb.Error):  # it may ask for what there is not
            database.execute(query).fetchall()
        assert not list(Path(folder).iterdir())
        assert database.execute("FROM t").fetchall() == [(1,)]
        assert not database.execute("FROM duckdb_views() WHERE NOT internal").fetchall()


ENDLESS = (
    "WITH RECURSIVE r AS (SELECT 1 AS n UNION ALL SELECT n FROM r) SELECT count(*) FROM r",
    "SELECT count(*) FROM range(10000000) a, range(1000000) b WHERE a.range * b.range % 7 = 1",
)


@pytest.mark.parametrize("endless", ENDLESS)
def test_an_endless_query_can_be_interrupted(root: Path, endless: str) -> None:
    with connect(root, query="log") as database:
        timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt), database_errors("the query"):
            timer.start()  # here, for it may come before the query on a busy machine
            interruptible(database, database.sql(endless).fetchall)
        timer.join()


def test_one_value_cannot_take_all_memory(root: Path, run_command: RunCommand) -> None:
    limit = 2 * 2**30
    result = run_command(
        "sql",
        "SELECT len(range(2000000000))",
        root=root,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (limit, limit)),
    )
    assert result.exit_code == StorageError.exit_code
    assert "Select less at once" in result.stderr


def test_a_connection_opens_no_other_file_and_writes_none_anew(root: Path, tmp_path: Path) -> None:
    before = contents(root)
    data = root / next(name for name in before if name.endswith(".parquet"))
    secret = tmp_path / "secret.csv"
    secret.write_text("a\n1\n")
    with connect(root, query="log") as database:
        for attack in (
            f"FROM read_csv('{secret}')",
            f"FROM '{secret}'",
            f"FROM glob('{tmp_path}/*')",
            f"COPY (SELECT 1) TO '{tmp_path}/new.csv'",
            f"COPY (SELECT 1) TO '{data}'",
            f"COPY (SELECT 1) TO '{data.parent}/new.parquet'",
            f"COPY (SELECT 1 AS a) TO '{root}/logs' (PARTITION_BY a, OVERWRITE)",
            f"EXPORT DATABASE '{root}/logs'",
            f"ATTACH '{root}/logs/new.db'",
            "SET enable_external_access = true",
            "RESET lock_configuration",
            "SET allowed_paths = ['/etc/passwd']",
            f"FROM '{root}/logs/../models'",
        ):
            with pytest.raises(duckdb.Error):
                database.execute(attack)
    assert contents(root) == before
    assert [file.name for file in tmp_path.iterdir()] == ["secret.csv"]


def test_unsafe_lifts_the_lock(run_command: RunCommand, root: Path, tmp_path: Path) -> None:
    copy = "COPY (SELECT 1 AS one) TO 'mine.csv'"
    assert run_command("sql", copy, root=root).exit_code == 5
    assert not (tmp_path / "mine.csv").exists()
    assert run_command("sql", copy, "--unsafe", root=root).exit_code == 0
    read = run_command("sql", "FROM 'mine.csv'", "--unsafe", "--json", root=root)
    assert json.loads(read.stdout) == [{"one": 1}]


def test_hostile_characters_reach_neither_terminal_nor_log(
    run_command: RunCommand, tmp_path: Path
) -> None:
    done = run_command("sql", "SELECT \x1b[31m", root=tmp_path / "evil\x1b[2J\nroot")
    assert done.exit_code == 6
    shown = run_command("sql", "SELECT chr(27) || '[2J' AS x")
    named = run_command("ingest", "a\x1b[2J\nb.csv", "--mapping", "race_car_250lm")
    assert named.exit_code == 4
    for text in (done.stderr, shown.stdout, named.stderr):
        assert "\x1b" not in text
    assert named.stderr.count("\n") == 1
