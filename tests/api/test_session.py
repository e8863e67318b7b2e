"""Many queries of one moment: what they see, what they may, and what stops them."""

import shutil
from pathlib import Path

import duckdb
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import QuestionError, StorageError

COUNT = "SELECT count(*) FROM drives"


def test_all_queries_of_a_session_see_the_same_commits(smoke_root: Path, tmp_path: Path) -> None:
    root = shutil.copytree(smoke_root, tmp_path / "data")
    fleet = fleet_slip.open(root)
    with fleet.session() as session:
        before = session.sql(COUNT).fetchall()
        fleet.forget(drive="smoke-2024-05-01-0000")
        assert session.sql(COUNT).fetchall() == before
    assert fleet.sql(COUNT).fetchall() != before


def test_an_answer_is_computed_as_a_table_or_by_a_function(fleet: Fleet) -> None:
    with fleet.session() as session:
        table = session.table("SELECT drive_id FROM drives ORDER BY ALL")
        assert table.num_rows > 1
        assert session.compute("FROM drives", len) == table.num_rows


def test_a_closed_session_answers_no_more(fleet: Fleet) -> None:
    with fleet.session() as session:
        pass
    with pytest.raises(duckdb.ConnectionException):
        session.database.execute("SELECT 1")


def test_an_unlocked_session_does_what_it_is_told(fleet: Fleet, tmp_path: Path) -> None:
    with fleet.session(unlocked=True) as session:
        session.sql(COUNT).write_csv(str(tmp_path / "out.csv"))
        session.table("CREATE TABLE own AS SELECT 1 AS a")
        assert session.table("FROM own").to_pylist() == [{"a": 1}]
        with pytest.raises(QuestionError, match="empty"):
            session.sql("")
    assert (tmp_path / "out.csv").exists()


def test_what_takes_long_is_computed_when_a_query_names_it(smoke_root: Path) -> None:
    with fleet_slip.open(smoke_root).session() as session:
        tables = "SELECT count(*) AS n FROM duckdb_tables() WHERE table_name = 'calibration'"
        assert session.table(tables.replace("calibration", "calib' || 'ration")).to_pylist() == [
            {"n": 0}
        ]
        asked = "SELECT count(DISTINCT vehicle_id) AS cars FROM calibration"
        first, again = (session.table(asked).to_pylist() for _ in range(2))
        assert first == again
        assert session.table(tables).to_pylist() == [{"n": 1}]


def test_an_answer_from_a_damaged_file_is_none(smoke_root: Path, tmp_path: Path) -> None:
    """A flipped bit of a count is a well-formed count."""
    root = shutil.copytree(smoke_root, tmp_path / "data")
    file = next((root / "logs").rglob("*.parquet"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.chmod(0o644)
    file.write_bytes(content)
    with (
        fleet_slip.open(root).session() as session,
        pytest.raises(StorageError, match=r"damaged|checksum"),
    ):
        session.table("SELECT sum(ax) FROM log_counts")
