"""Several files of one drive: lakes of messages, patterns of files, and rasters of one file."""

import pickle
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from fleet_slip.errors import InputError
from fleet_slip.ingest.log_files import FileGroup, find_logs
from fleet_slip.ingest.mapping import Mapping
from tests.support.commands import run_on
from tests.support.measured import OWN_CLOCK, a_mapping, csv_text, own_clock, read_measured

START = datetime(2024, 6, 3, 23, 59, 30, tzinfo=UTC)
LAKE = {
    "ax": {"column": "CAN1_Motion/a_x", "unit": "m/s^2"},
    "sideslip": {"column": "CAN2_Reference/beta", "unit": "deg"},
}


def write_message(
    lake: Path, message: str, start: datetime, name: str, device: str = "A1", **columns: Any
) -> None:
    """Write 30 s of a message; its columns are functions of the time in s."""
    time_s = np.arange(0, 30, 0.01 if message == "CAN1_Motion" else 0.02) + 0.003
    moments = [start + timedelta(seconds=t) for t in time_s.tolist()]
    table = {"t": pl.Series(moments, dtype=pl.Datetime("us", "UTC"))}
    table |= {key: pl.Series(function(time_s)) for key, function in columns.items()}
    file = lake / device / message / f"{start:%Y/%m/%d}" / f"{name}.parquet"
    file.parent.mkdir(parents=True, exist_ok=True)
    pl.DataFrame(table).write_parquet(file)


def write_split(lake: Path, start: datetime, name: str, device: str = "A1") -> None:
    """Write both messages of a split; ax is 1 in the device A1, 2 in others."""
    value = 1.0 if device == "A1" else 2.0
    write_message(lake, "CAN1_Motion", start, name, device, a_x=lambda t: np.full(t.size, value))
    write_message(lake, "CAN2_Reference", start, name, device, beta=np.sin)


def members_of(log: Path) -> dict[str, tuple[Path, ...]]:
    """Return the files of a log by member."""
    assert isinstance(log, FileGroup)
    return dict(log.members)


def lake_mapping(**changes: Any) -> Mapping:
    drive = {"vehicle_id": {"path": "{}/*"}, "day": None}
    return own_clock(**{"signals": LAKE, "drive": drive, **changes})


def test_the_messages_of_a_session_are_joined_and_its_splits_are_one_trip(tmp_path: Path) -> None:
    lake = tmp_path / "lake"
    for split in range(3):  # over midnight
        write_split(lake, START + timedelta(seconds=30 * split), f"00000001_{split + 1:08}")
    write_split(lake, START + timedelta(days=2), "00000001_00000001")  # its number comes again
    write_split(lake, START, "00000001_00000001", device="B2")
    logs = find_logs([lake])
    assert [str(log.relative_to(lake)) for log in logs] == [
        "A1/2024-06-03_00000001", "A1/2024-06-05_00000001", "B2/2024-06-03_00000001",
    ]  # fmt: skip
    copy = pickle.loads(pickle.dumps(logs[0]))  # noqa: S301 - our own
    assert members_of(copy) == members_of(logs[0])
    log = read_measured(logs[0], lake_mapping())
    assert (log.counts.drives, log.counts.ticks) == (1, 9000)
    assert set(log.drives["vehicle_id"].to_pylist()) == {"A1"}
    assert set(log.drives["ax"].to_pylist()) == {1000}
    assert log.drives["sideslip"].null_count <= 2
    assert set(read_measured(logs[2], lake_mapping()).drives["ax"].to_pylist()) == {2000}


def test_a_message_that_a_split_lacks_is_missing_there(tmp_path: Path) -> None:
    write_split(tmp_path, START, "1_1")
    second = START + timedelta(seconds=30)
    write_message(tmp_path, "CAN1_Motion", second, "1_2", a_x=lambda t: np.full(t.size, 3.0))
    (group,) = find_logs([tmp_path])
    log = read_measured(group, lake_mapping())
    assert set(log.drives["ax"].to_pylist()[3100:]) == {3000}
    assert 2900 < log.drives["sideslip"].null_count < 3100


def test_a_lake_is_drafted_ingested_once_and_again_when_a_split_comes(tmp_path: Path) -> None:
    lake, draft, root = tmp_path / "lake", tmp_path / "draft.toml", tmp_path / "root"
    write_split(lake, START, "1_1")
    assert run_on(root, "mapping", "suggest", lake, "--output", draft).exit_code == 0
    text = draft.read_text()
    assert 'ax = { column = "CAN1_Motion/a_x", unit = "choose" }' in text
    assert 'vehicle_id = { path = "{}/*" }' in text
    text = text.replace('# vehicle_model = ""', 'vehicle_model = "s"')
    text = text.replace('beta", unit = "choose"', 'beta", unit = "deg"').replace("choose", "m/s^2")
    draft.write_text(text)
    for new in ("1 new file", "nothing new"):
        printed = run_on(root, "ingest", lake, "--mapping", draft)
        assert new in printed.stderr
    write_split(lake, START + timedelta(seconds=30), "1_2")
    printed = run_on(root, "ingest", lake, "--mapping", draft, "--replace")
    assert "1 new file: 6,000 rows in 1 drive; 1 drive replaced" in printed.stderr


def test_files_of_patterns_are_one_log(tmp_path: Path) -> None:
    time_s = np.arange(100) / 100
    for day, value in (("mon", 1.0), ("tue", 2.0)):
        imu = {"t": 1000 * time_s + 1717156800000, "ax": np.full(100, value)}
        (tmp_path / f"{day}_imu.csv").write_text(csv_text(imu))
        times = pl.Series(time_s + 1717156800).cast(pl.Float64) * 1e6
        gps = {"at": times.cast(pl.Datetime("us", "UTC")), "beta": np.full(100, 0.5)}
        pl.DataFrame(gps).write_parquet(tmp_path / f"{day}_gps.parquet")
    (tmp_path / "other.csv").write_text("a\n1\n")
    mapping = a_mapping(
        time=OWN_CLOCK,
        drive={"day": None, "vehicle_id": {"path": "{}"}},
        signals={
            "ax": {"column": "imu/ax", "unit": "m/s^2"},
            "sideslip": {"column": "gps/beta", "unit": "deg"},
        },
        file=[
            {"name": "imu", "path": "{}_imu.csv", "time": {"column": "t", "unit": "ms"}},
            {"name": "gps", "path": "{}_gps.parquet", "time": {"column": "at"}},
        ],
    )
    logs = find_logs([tmp_path], mapping)
    assert [log.name for log in logs] == ["mon", "tue"]
    assert [file.name for file in logs.passed_over] == ["other.csv"]
    for log, value in zip(logs, (1000, 2000), strict=True):
        drives = read_measured(log, mapping).drives
        assert set(drives["ax"].to_pylist()) == {value}
        assert set(drives["sideslip"].to_pylist()) == {87}
        assert set(drives["vehicle_id"].to_pylist()) == {log.name}
    alone = FileGroup.create(tmp_path / "mon", {"imu": members_of(logs[0])["imu"]})
    with pytest.raises(InputError, match="no column 'gps/beta'"):
        read_measured(alone, mapping)


def raster_text(times: list[str], slow: list[str]) -> str:
    """Write ax each 10 ms and beta each 20 ms, with a column of times before each."""
    lines = ["t_10ms;ax;t_20ms;beta"]
    for i, time in enumerate(times):
        lines.append(f"{time};{i % 5};" + (f"{slow[i]};0,5" if i < len(slow) else ";"))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("kind", ["numbers", "timestamps", "short lines"])
def test_a_raster_of_csv_has_its_own_times(tmp_path: Path, kind: str) -> None:
    moments = [START + timedelta(milliseconds=10 * i) for i in range(200)]
    time: dict[str, Any] = {"column": "t_10ms", "unit": None, "format": "%d.%m.%Y %H:%M:%S%.f"}
    texts = [f"{moment:%d.%m.%Y %H:%M:%S.%f}" for moment in moments]
    if kind != "timestamps":
        texts = [f"{i / 100:.2f}".replace(".", ",") for i in range(200)]
        time = {"column": "t_10ms", "unit": "s"}
    text = raster_text(texts, texts[::2])
    file = tmp_path / "log.csv"
    file.write_text(text.replace(";;", "") if kind == "short lines" else text)
    signals = {
        "ax": {"column": "ax", "unit": "m/s^2"},
        "sideslip": {"column": "beta", "unit": "deg", "time": "t_20ms"},
    }
    layout = {"separator": ";", "decimal_comma": True}
    log = read_measured(file, a_mapping(time=time, signals=signals, csv=layout))
    assert log.drives["ax"].to_pylist() == [1000 * (i % 5) for i in range(200)]
    assert log.drives["sideslip"].to_pylist() == [87] * 199 + [None]
    assert log.counts.quarantined == {}


def test_times_of_a_raster_in_milliseconds_split_at_gaps_in_seconds(tmp_path: Path) -> None:
    table = {"a": [*range(0, 1000, 10), *range(1500, 2500, 10)], "ax": [1.0] * 200}
    table |= {"b": table["a"], "beta": [0.5] * 200}
    pl.DataFrame(table).write_parquet(tmp_path / "log.parquet")
    signals = {
        "ax": {"column": "ax", "unit": "m/s^2"},
        "sideslip": {"column": "beta", "unit": "deg", "time": "b"},
    }
    mapping = a_mapping(time={"column": "a", "unit": "ms"}, signals=signals)
    log = read_measured(tmp_path / "log.parquet", mapping)
    assert (log.counts.drives, log.counts.rows_kept) == (1, 400)
