"""How far a log is read, and about how many rows it has, is told while it is read."""

from pathlib import Path

import polars as pl
import pytest

import fleet_slip
from fleet_slip.ingest.drives import stream
from fleet_slip.ingest.formats import csv_batches
from fleet_slip.ingest.formats.reading import expected_rows
from tests.support.measured import a_mapping, csv_text, good_columns

ROWS = 30_000


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("log") / "log.csv"
    columns = good_columns(ROWS)
    columns["ax"] = [f"{i % 19:.1f}" for i in range(ROWS)]
    columns["beta"] = [f"{i % 7:.1f}" for i in range(ROWS)]
    file.write_text(csv_text(columns))
    return file


def test_a_parquet_file_says_its_rows_and_text_is_judged_by_its_begin(
    log: Path, tmp_path: Path
) -> None:
    assert expected_rows(log) == pytest.approx(ROWS, rel=0.1)
    pl.read_csv(log).write_parquet(tmp_path / "log.parquet")
    assert expected_rows(tmp_path / "log.parquet") == ROWS


@pytest.mark.parametrize("content", [b"", b"one line", bytes(range(256)) * 9, b"PAR1" * 9])
def test_what_is_no_log_expects_nothing_and_raises_nothing(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "log"
    file.write_bytes(content)
    assert expected_rows(file) == 0
    assert expected_rows(tmp_path / "none") == 0


def test_ingest_tells_rows_that_grow_to_all(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csv_batches, "BLOCK_BYTES", 2**15)
    monkeypatch.setattr(stream, "RATE_ROWS", 2**11)
    told: list[tuple[int, int]] = []
    fleet = fleet_slip.open(tmp_path / "data")
    fleet.ingest(log, a_mapping(), progress=lambda done, total: told.append((done, total)))
    done = [one for one, _ in told]
    assert len(set(done)) > 1
    assert done == sorted(done)
    assert {total for _, total in told} == {expected_rows(log)}
    assert done[-1] >= 0.9 * told[-1][1]
    assert all(one <= total for one, total in told)


def test_of_a_folder_files_are_told(log: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    fleet = fleet_slip.open(tmp_path / "data")
    fleet.ingest(log.parent, a_mapping(), progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (1, 1)
