"""A fleet in Python: what a notebook asks of it."""

import gc
import html
import sys
import threading
from pathlib import Path
from typing import assert_type

import duckdb
import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.api.fleet_models import FleetCohort
from fleet_slip.errors import QuestionError, StorageError
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.summary import Selection
from tests.support.commands import run, run_on


def test_opening_touches_nothing_and_the_root_follows_the_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("FLEET_SLIP_ROOT", raising=False)
    assert str(fleet_slip.open().root) == "data"
    monkeypatch.setenv("FLEET_SLIP_ROOT", "elsewhere")
    assert repr(fleet_slip.open()) == "Fleet('elsewhere')"
    assert str(fleet_slip.open(tmp_path / "x").root) == str(tmp_path / "x")
    assert not list(tmp_path.iterdir())
    with pytest.raises(StorageError, match="s3://BUCKET/PATH"):
        fleet_slip.open("ftp://somewhere/else")


def test_importing_the_package_imports_no_engine() -> None:
    program = "import sys, fleet_slip; print(*sys.modules)"
    done = run([sys.executable, "-c", program])
    assert done.exit_code == 0, done.stderr
    assert not {"numpy", "pyarrow", "duckdb", "polars", "pydantic"} & {*done.stdout.split()}


def test_the_lines_that_help_shows_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line[4:] for line in fleet_slip.__doc__.splitlines() if line.startswith("    ")]
    assert len(lines) == 9
    namespace: dict[str, object] = {}
    exec("\n".join(lines), namespace)  # noqa: S102
    assert len(namespace["beta_rad"]) == len(namespace["log"])  # type: ignore[arg-type]


def test_a_relation_keeps_its_connection(fleet: Fleet) -> None:
    relation = fleet.sql("SELECT drive_id, ax_mps2 FROM log").filter("ax_mps2 > 0")
    gc.collect()
    counted = relation.aggregate("count(*) AS n")
    del relation
    gc.collect()
    ((n,),) = counted.fetchall()
    assert n > 10_000
    again = fleet.sql("SELECT count(*) FROM log WHERE ax_mps2 > 0").fetchall()
    assert again == [(n,)]


def test_a_long_query_of_an_interactive_python_prints_nothing(fleet: Fleet) -> None:
    program = (  # run with -c, as DuckDB tells that nobody runs a script
        f"import fleet_slip; fleet = fleet_slip.open({str(fleet.root)!r});"
        "setting = \"SELECT value FROM duckdb_settings() WHERE name = 'enable_progress_bar'\";"
        "print(fleet.sql(setting).fetchall())"
    )
    assert run([sys.executable, "-c", program]).stdout == "[('false',)]\n"


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("COPY (SELECT 1) TO 'x.csv'", "only queries are allowed"),
        ("DROP VIEW log", "only queries are allowed"),
        ("SET threads = 1", "only queries are allowed"),
        ("SELECT 1; SELECT 2", "one SQL statement is expected, not 2"),
        ("", "one SQL statement is expected, not 0"),
        ("SELECT nothing FROM log", "the query failed: Binder Error"),
        ("FROM read_csv('/etc/passwd')", "cannot be called after FROM"),
        ("SELECT 'a' ||", "not valid SQL"),
    ],
)
def test_a_query_reads_the_warehouse_and_nothing_else(
    fleet: Fleet, query: str, message: str
) -> None:
    with pytest.raises(QuestionError, match=message):
        fleet.sql(query)


def test_a_relation_cannot_write(fleet: Fleet, tmp_path: Path) -> None:
    relation = fleet.sql("SELECT 1 AS a")
    with pytest.raises(Exception, match=r"(?i)disabled|permission"):
        relation.write_parquet(str(tmp_path / "x.parquet"))
    assert not list(tmp_path.iterdir())


def test_a_wrong_root_is_not_an_empty_warehouse(tmp_path: Path) -> None:
    nowhere = fleet_slip.open(tmp_path / "nothing")
    for ask in (lambda: nowhere.sql("FROM log"), nowhere.models.versions):
        with pytest.raises(StorageError, match="no data root"):
            ask()


def test_threads_share_a_fleet_and_a_model(fleet: Fleet) -> None:
    model = fleet.models.get("bent")
    answers: dict[int, object] = {}

    def ask(number: int) -> None:
        rows = fleet.sql(f"FROM log WHERE tick % 2 = {number % 2} ORDER BY drive_id, tick").pl()
        answers[number] = model.predict(rows).to_list()

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert answers[0] == answers[2] != answers[1] == answers[3]


COUNT = "SELECT count(*) FROM drives"


def test_all_queries_of_a_session_see_the_same_commits(smoke_copy: Path) -> None:
    fleet = fleet_slip.open(smoke_copy)
    with fleet.session() as session:
        before = session.sql(COUNT).fetchall()
        fleet.maintenance.forget(drive="smoke-2024-05-01-0000")
        assert session.sql(COUNT).fetchall() == before
    assert fleet.sql(COUNT).fetchall() != before


def test_an_unlocked_session_does_what_it_is_told(fleet: Fleet, tmp_path: Path) -> None:
    with fleet.session(unlocked=True) as session:
        session.sql(COUNT).write_csv(str(tmp_path / "out.csv"))
        session.table("CREATE TABLE own AS SELECT 1 AS a")
        assert session.table("FROM own").to_pylist() == [{"a": 1}]
        with pytest.raises(QuestionError, match="empty"):
            session.sql("")
    assert (tmp_path / "out.csv").exists()


def test_an_answer_from_a_damaged_file_is_none(smoke_copy: Path) -> None:
    """A flipped bit of a count is a well-formed count."""
    file = next((smoke_copy / "logs").rglob("*.parquet"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.chmod(0o644)
    file.write_bytes(content)
    with (
        fleet_slip.open(smoke_copy).session() as session,
        pytest.raises(StorageError, match=r"damaged|checksum"),
    ):
        session.table("SELECT sum(ax) FROM log_counts")


def test_answers_are_shown_on_a_line_or_two(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    cohort = fleet.cohort()
    selection = cohort.select(models="table1")
    assert repr(selection).startswith("<Selection: ")
    assert "RMSE" in repr(selection)
    model = fleet.models.get("smoke")
    assert repr(model).startswith("<ModelVersion smoke@1: ")
    for answer in (selection, model, fleet.maintenance.status()):
        assert len(repr(answer)) < 500
    assert len(repr(selection.models[0].model)) < 200  # its fractions may have 10,000 digits
    assert "Fraction" not in repr(cohort.diagnose(model))


def test_a_notebook_shows_what_commands_print(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    selection = fleet.cohort("campaign <> '<script>'").select(models="table1")
    assert f"winner: {selection.winner.model.name}. " in selection._repr_html_()
    page = fleet.models.get("smoke")._repr_html_()
    lines = run_on(smoke_root, "show").stdout.rstrip().split("\n")
    shown = "\n".join(line for line in lines if not line.startswith("on board"))
    assert html.unescape(page) == f"<pre>{shown}</pre>"
    assert "&lt;script&gt;" in selection._repr_html_()
    assert "<script>" not in selection._repr_html_() + page


def test_a_users_lines_are_typed(fleet: Fleet) -> None:
    assert_type(fleet_slip.open("data"), Fleet)
    cohort = assert_type(fleet.cohort("adhesion > 0.9"), FleetCohort)
    selection = assert_type(cohort.select(models="table1", folds=3), Selection)
    assert_type(selection.winner.model.correlation, float)
    assert_type(fleet.maintenance.status().problems, tuple[str, ...])
    log = assert_type(fleet.sql("FROM log LIMIT 10"), duckdb.DuckDBPyRelation).pl()
    model = assert_type(fleet.models.get("smoke@1"), ModelVersion)
    frame = pl.DataFrame(log)
    assert isinstance(assert_type(model.predict(frame), pl.Series), pl.Series)
    columns = {name: frame[name].to_numpy() for name in model.columns}
    angles: NDArray[np.float64] = model.predict(columns)
    assert angles.dtype == np.float64
