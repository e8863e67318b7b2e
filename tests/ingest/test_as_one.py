"""A folder as one log: drives go on from file to file."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
import pytest
from asammdf import MDF, Signal

from fleet_slip.errors import InputError, UsageError
from fleet_slip.ingest import stream
from fleet_slip.ingest.formats.reading import log_digest
from fleet_slip.ingest.load import preview_log
from tests.ingest.test_formats import AX, BETA_DEG, START, TIME_S, mdf_mapping, require_the_drive
from tests.support.measured import (
    a_mapping,
    csv_text,
    good_columns,
    read_columns,
    read_measured,
    ticks,
)
from tests.support.reported import call

MAPPING = """name = "test"
time = { column = "t", unit = "s" }
drive = { day = 2024-05-31, vehicle_id = "car", vehicle_model = "sedan" }
signals.ax = { column = "ax", unit = "m/s^2" }
signals.sideslip = { column = "beta", unit = "deg" }
"""


def write_parts(folder: Path, *slices: slice, rows: int = 30) -> Path:
    columns = good_columns(rows)
    folder.mkdir(exist_ok=True)
    for number, part in enumerate(slices):
        text = csv_text({name: values[part] for name, values in columns.items()})
        (folder / f"part-{number}.csv").write_text(text, encoding="utf-8")
    return folder


def test_a_drive_goes_on_from_file_to_file(tmp_path: Path) -> None:
    parts = write_parts(tmp_path / "drive", slice(0, 10), slice(10, 11), slice(11, 30))
    log = read_measured(parts, a_mapping())
    whole = read_columns(tmp_path, good_columns(30))
    named = ["drive_id", "drive_name", "source_file", "trip_id"]
    assert log.drives.drop_columns(named) == whole.drives.drop_columns(named)
    assert log.counts == whole.counts
    assert log.digest != whole.digest


def test_files_with_a_clock_follow_one_another_and_have_one_time_base(tmp_path: Path) -> None:
    logs = tmp_path / "drive"
    logs.mkdir()
    for name, part in (("a", slice(0, 40)), ("b", slice(40, 100))):
        file, time_s = logs / f"{name}.mf4", TIME_S[part]
        pair = [Signal(AX[part], time_s, name="a_x"), Signal(BETA_DEG[part], time_s, name="beta")]
        with MDF(version="4.10") as mdf:
            mdf.start_time = START
            mdf.append(pair)
            mdf.save(file)
    require_the_drive(read_measured(logs, mdf_mapping()))
    with MDF(version="4.10") as mdf:
        for one in pair:
            mdf.append([one])
        mdf.save(file, overwrite=True)
    with pytest.raises(InputError, match=r"b\.mf4: its signals have 2 time bases; --as-one"):
        read_measured(logs, mdf_mapping())


def test_a_hive_dataset_is_one_log(tmp_path: Path) -> None:
    table = pa.table({"t": TIME_S, "ax": AX, "beta": BETA_DEG, "car": ["A7"] * 50 + ["B2"] * 50})
    hive = ds.partitioning(pa.schema([("car", pa.string())]), flavor="hive")
    ds.write_dataset(table, tmp_path / "set", format="parquet", partitioning=hive)
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}})
    drives = read_measured(tmp_path / "set", mapping).drives.to_pylist()
    assert [d["vehicle_id"] for d in drives] == ["A7"] * 50 + ["B2"] * 50


def test_a_part_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    parts = write_parts(tmp_path / "drive", slice(0, 10), slice(10, 30))
    (parts / "part-1.csv").write_bytes(b"t,ax\n0.1,2\n")
    with pytest.raises(InputError, match=r"part-1\.csv: no column 'beta'"):
        read_measured(parts, a_mapping())


def test_a_folder_that_grows_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = write_parts(tmp_path / "drive", slice(0, 10), slice(10, 20))

    def grow(log: Path) -> Any:
        (log / "part-2.csv").write_text("t,ax,beta\n9.0,1,2\n", encoding="utf-8")
        return log_digest(log)

    monkeypatch.setattr(stream, "log_digest", grow)
    with pytest.raises(InputError, match="drive: files came or went while it was read"):
        preview_log(parts, a_mapping())


def test_a_folder_lands_once_and_not_again_when_it_has_grown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    parts = write_parts(tmp_path / "drive", slice(0, 10), slice(10, 20))
    (tmp_path / "m.toml").write_text(MAPPING, encoding="utf-8")
    command = ("ingest", str(parts), "--mapping", str(tmp_path / "m.toml"), "--as-one")
    root = tmp_path / "root"
    for new in (True, False):
        (report,) = json.loads(call(root, *command, "--json"))
        assert (report["new"], report["drives"], report["ticks"]) == (new, 1, 20)
    write_parts(parts, slice(0, 10), slice(10, 20), slice(20, 30))
    with pytest.raises(InputError, match=r"drive: it has changed since it was ingested"):
        call(root, *command)
    assert "1 drive of 30 ticks" in call(root, *command, "--dry-run")
    with pytest.raises(UsageError, match="--as-one needs a local folder"):
        call(root, "ingest", str(parts / "part-0.csv"), *command[2:])
    assert ticks(read_measured(parts, a_mapping())) == list(range(30))
