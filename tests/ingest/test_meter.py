"""How far a log is read is told in its bytes while it is read, whatever its format."""

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from nptdms import ChannelObject

import fleet_slip
from fleet_slip.errors import InputError
from fleet_slip.ingest import stream, time_bases
from fleet_slip.ingest.formats import can as can_frames
from fleet_slip.ingest.formats import can_files, mdf
from fleet_slip.ingest.formats import csv as csv_batches
from fleet_slip.ingest.formats.reading import FileFormats, open_source
from fleet_slip.ingest.log_files import size_of
from fleet_slip.ingest.mapping import Mapping, load_mapping
from tests.ingest import test_can, test_formats, test_mcap, test_tdms
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


def expected_rows(file: Path) -> int:
    with open_source(file, FileFormats()) as source:
        return source.expected_rows(["ax"])


def told_of(given: Path, mapping: Mapping, root: Path, **more: Any) -> list[tuple[int, int]]:
    told: list[tuple[int, int]] = []
    fleet = fleet_slip.open(root)
    fleet.ingest(given, mapping, progress=lambda done, total: told.append((done, total)), **more)
    return told


def require_growing(told: list[tuple[int, int]], size: int) -> None:
    done = [one for one, _ in told]
    assert len(set(done)) == len(done) > 1
    assert done == sorted(done)
    assert told[-1] == (size, size)
    assert {total for _, total in told} == {size}


def test_a_parquet_file_says_its_rows_and_text_is_judged_by_its_begin(
    log: Path, tmp_path: Path
) -> None:
    assert expected_rows(log) == pytest.approx(ROWS, rel=0.1)
    pl.read_csv(log).write_parquet(tmp_path / "log.parquet")
    assert expected_rows(tmp_path / "log.parquet") == ROWS


def test_ingest_tells_bytes_that_grow_to_all(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csv_batches, "BLOCK_BYTES", 2**15)
    monkeypatch.setattr(stream, "RATE_ROWS", 2**11)
    require_growing(told_of(log, a_mapping(), tmp_path / "data"), log.stat().st_size)


def own_clock(folder: Path, name: str) -> tuple[Path, Mapping]:
    if name == "log.mf4":
        file = test_formats.write_mdf(folder, [test_formats.a_x()], [test_formats.beta()])
        return file, test_formats.mdf_mapping()
    if name == "log.mcap":
        return test_mcap.write(folder / name), test_mcap.mapping()
    if name == "log.tdms":
        waves = zip(["ax", "beta"], [0.01, 0.1], strict=True)
        channels = [ChannelObject("g", of, np.ones(50), test_tdms.wave(s)) for of, s in waves]
        return test_tdms.write(folder / name, channels), test_tdms.own_clock()
    (folder / "car.dbc").write_text(test_can.DBC)
    (folder / "bus.toml").write_text(
        test_can.MAPPING.replace("[drive]", "[drive]\nday = 2024-05-31")
    )
    file = test_can.write_trace(folder, [*map(test_can.motion, range(50))], name)
    return file, load_mapping(str(folder / "bus.toml"))


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("name", ["log.mf4", "log.tdms", "log.mcap", "log.asc"])
def test_a_file_with_a_clock_tells_bytes_too(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(can_files, "AT_ONCE", 8)
    monkeypatch.setattr(can_frames, "PIECE_FRAMES", 8)
    monkeypatch.setattr(mdf, "WINDOW_RECORDS", 10)
    monkeypatch.setattr(time_bases, "WINDOW_ROWS", 20)
    monkeypatch.setattr(stream, "RATE_ROWS", 20)
    monkeypatch.setattr(stream, "FEWEST_STEPS", 2)
    file, mapping = own_clock(tmp_path, name)
    require_growing(told_of(file, mapping, tmp_path / "data"), file.stat().st_size)


def test_several_files_of_one_log_tell_bytes_of_all(log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "parts"
    folder.mkdir()
    rows = pl.read_csv(log)
    for number in range(2):
        rows[number * 15_000 :][:15_000].write_parquet(folder / f"{number}.parquet")
    told = told_of(folder, a_mapping(), tmp_path / "data", as_one=True)
    assert told[-1] == (size_of(folder), size_of(folder))


def test_of_a_folder_files_are_told(log: Path, tmp_path: Path) -> None:
    told = told_of(log.parent, a_mapping(), tmp_path / "data")
    assert told[-1] == (1, 1)


def test_a_log_that_cannot_be_read_tells_no_end(tmp_path: Path) -> None:
    (tmp_path / "log.mf4").write_bytes(b"MDF     4.10" + bytes(200))
    told: list[int] = []
    with pytest.raises(InputError):
        fleet_slip.open(tmp_path / "data").ingest(
            tmp_path / "log.mf4", a_mapping(), progress=lambda done, _: told.append(done)
        )
    assert told == []
