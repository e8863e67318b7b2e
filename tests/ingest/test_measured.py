"""Files with known content through the whole way."""

from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import InputError
from fleet_slip.ingest import checked_columns, measured_log
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.warehouse.warehouse import quarantine_schema
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.logs import schema_without, without_names
from tests.support.measured import (
    a_mapping,
    csv_text,
    good_columns,
    physical,
    read_columns,
    read_measured,
    read_text,
    reasons,
    ticks,
)


def test_the_table_has_the_schema_of_the_logs(tmp_path: Path) -> None:
    log = read_columns(tmp_path, good_columns())
    table = log.drives.cast(schema_without(SIGNALS.extras))
    first = table.slice(0, 1).to_pylist()[0]
    facts = {
        "day": date(2024, 5, 31),
        "drive_id": f"test-{log.digest[:12]}-1",
        "vehicle_id": "car",
        "vehicle_model": "sedan",
        "source": "measured",
        "campaign": "test",
        "drive_name": "log",
        "source_file": "log.csv",
        "trip_id": f"test-{log.digest[:12]}-1",
        "duration_s": pytest.approx(0.19),
        "rows": 20,
        "saturated": 0,
        "tick": 0,
        "ax": -1000,
        "sideslip": 0,
    }
    assert {name: value for name, value in first.items() if value is not None} == facts
    assert log.quarantine.schema == quarantine_schema()
    assert log.quarantine.num_rows == 0


def test_absent_values_stay_null(tmp_path: Path) -> None:
    columns = good_columns(4)
    columns["ax"][1] = None
    columns["beta"][2] = "NaN"
    log = read_columns(tmp_path, columns, a_mapping(missing=["NaN"]))
    assert log.drives["ax"].to_pylist() == [-1000, None, -800, -700]
    assert log.drives["sideslip"].to_pylist() == [0, 87, None, 262]
    assert log.drives["yaw_rate"].null_count == 4
    assert log.counts.rows_kept == 4


def test_missing_marks_in_parquet(tmp_path: Path) -> None:
    table = {"t": np.arange(4) / 100, "ax": [1, np.nan, -99, 2], "beta": np.zeros(4)}
    pq.write_table(pa.table(table), tmp_path / "log.parquet")
    log = read_measured(tmp_path / "log.parquet", a_mapping(missing=["nan", "-99", "n/a"]))
    assert log.drives["ax"].to_pylist() == [1000, None, None, 2000]


@pytest.mark.parametrize(
    ("column", "value", "reason", "signal"),
    [
        ("ax", "fast", "not_a_number", "ax"),
        ("ax", "1,5", "extra_fields", None),
        ("ax", "-inf", "not_finite", "ax"),
        ("ax", "1e308", "out_of_range", "ax"),
        ("ax", "1e999", "not_finite", "ax"),
        ("ax", "30.001", "out_of_range", "ax"),
        ("beta", "-184", "out_of_range", "sideslip"),
        ("t", "", "missing", "time"),
        ("t", "noon", "not_a_number", "time"),
        ("t", "inf", "not_finite", "time"),
        ("t", "0.04", "time_duplicate", "time"),
        ("t", "0.02", "time_backwards", "time"),
        ("t", "1e300", "isolated", "time"),
        ("t", "-1e300", "isolated", "time"),
    ],
)
def test_a_bad_row_is_quarantined_and_the_others_keep_their_ticks(
    tmp_path: Path, column: str, value: str, reason: str, signal: str | None
) -> None:
    columns = good_columns()
    columns[column][5] = value
    log = read_columns(tmp_path, columns)
    assert reasons(log) == [(6, reason, signal)]
    assert ticks(log) == [i for i in range(20) if i != 5]
    assert log.counts.quarantined == {reason: 1}
    rejected = log.quarantine.to_pylist()[0]
    assert rejected["drive_id"] == log.drives["drive_id"][0].as_py()
    assert rejected["file"] == "log.csv"


def test_the_limits_of_the_range_are_valid(tmp_path: Path) -> None:
    columns = {"t": [0, 0.01], "ax": [30, -30], "beta": ["-0", ""]}
    log = read_columns(tmp_path, columns)
    assert log.drives["ax"].to_pylist() == [30000, -30000]
    assert log.drives["sideslip"].to_pylist() == [0, None]


def test_a_row_without_any_value_is_quarantined(tmp_path: Path) -> None:
    log = read_text(tmp_path, csv_text(good_columns()) + "0.20,,\n\n0.22,1,1\n")
    assert reasons(log) == [(21, "no_value", None), (22, "missing", "time")]
    assert ticks(log)[-1] == 22


def test_a_clock_that_restarts_begins_a_drive(tmp_path: Path) -> None:
    columns = good_columns(300)
    columns["t"] = [f"{i % 150 / 100:.2f}" for i in range(300)]
    log = read_columns(tmp_path, columns)
    assert ticks(log) == [*range(150)] * 2
    assert log.counts.quarantined == {}


def test_a_lone_row_is_no_drive(tmp_path: Path) -> None:
    columns = {"t": [0, 0.01, 7, 14, 14.001], "ax": [1] * 5, "beta": [1] * 5}
    log = read_columns(tmp_path, columns)
    time = "time"
    assert reasons(log) == [(3, "isolated", time), (4, "too_short", time), (5, "too_short", time)]


def test_drives_from_columns_may_alternate(tmp_path: Path) -> None:
    rows = 24
    columns: dict[str, Any] = {
        "t": [i // 2 / 100 for i in range(rows)],
        "car": ["it's", "b"] * (rows // 2),
        "mass": ["1000", "1740.5"] * (rows // 2),
        "date": ["2024-05-31"] * 12 + ["2024-06-01"] * 12,
        "ax": list(range(rows)),
        "beta": [1] * rows,
    }
    columns["car"][3] = ""
    columns["mass"][4] = "-5"
    columns["date"][5] = "31/5/2024"
    drive = {
        "vehicle_id": {"column": "car"},
        "mass_kg": {"column": "mass"},
        "day": {"column": "date"},
    }
    log = read_columns(tmp_path, columns, a_mapping(drive=drive))
    assert reasons(log) == [
        (4, "missing", "vehicle_id"),
        (5, "out_of_range", "mass_kg"),
        (6, "not_a_time", "day"),
    ]
    assert log.quarantine["drive_id"].null_count == 3
    drives = (
        log.drives.cast(schema_without(SIGNALS.extras))
        .group_by(["drive_id", "day", "vehicle_id", "mass_kg"])
        .aggregate([("tick", "count"), ("ax", "min")])
    )
    got = [tuple(row.values())[1:] for row in drives.sort_by("drive_id").to_pylist()]
    assert got == [
        (date(2024, 5, 31), "it's", 1000.0, 5, 0),
        (date(2024, 5, 31), "b", 1740.5, 4, 1000),
        (date(2024, 6, 1), "it's", 1000.0, 6, 12000),
        (date(2024, 6, 1), "b", 1740.5, 6, 13000),
    ]
    assert log.drives["drive_id"].to_pylist() == sorted(log.drives["drive_id"].to_pylist())


def test_names_are_normalized_and_checked(tmp_path: Path) -> None:
    columns = good_columns(16)
    names = [" Zoe\u0308 ", "Zo\u00eb", "V\x1b[2J", "V" * 201]
    columns["car"] = [name for name in names for _ in range(4)]
    log = read_columns(tmp_path, columns, a_mapping(drive={"vehicle_id": {"column": "car"}}))
    assert set(log.drives["vehicle_id"].to_pylist()) == {"Zo\u00eb"}
    assert len(set(log.drives["drive_id"].to_pylist())) == 1
    assert reasons(log) == [(row, "out_of_range", "vehicle_id") for row in range(9, 17)]


def test_the_column_of_drives_may_hold_numbers(tmp_path: Path) -> None:
    table = {
        "t": np.arange(6) / 100,
        "ax": np.ones(6),
        "beta": np.ones(6),
        "run": [7] * 3 + [9] * 3,
    }
    pq.write_table(pa.table(table), tmp_path / "log.parquet")
    drive = {"column": "run", "vehicle_id": {"column": "run"}}
    log = read_measured(tmp_path / "log.parquet", a_mapping(drive=drive))
    assert log.drives["vehicle_id"].to_pylist() == ["7"] * 3 + ["9"] * 3
    assert log.counts.drives == 2


@pytest.mark.parametrize("kind", ["text", "zone", "parquet"])
def test_timestamps_give_time_and_day(tmp_path: Path, kind: str) -> None:
    start = datetime(2024, 2, 29, 23, 59, 59, 950_000, tzinfo=UTC)
    moments = [start + timedelta(milliseconds=10 * i) for i in range(20)]
    columns: dict[str, Any] = {"t": moments, "ax": [1.0] * 20, "beta": [1.0] * 20}
    if kind == "parquet":
        pq.write_table(pa.table(columns), tmp_path / "log.parquet")
        mapping = a_mapping(time={"unit": None}, drive={"day": None})
        log = read_measured(tmp_path / "log.parquet", mapping)
    else:
        form = "%Y-%m-%dT%H:%M:%S%.f" + ("%z" if kind == "zone" else "")
        zone = "+0000" if kind == "zone" else ""
        columns["t"] = [f"{m:%Y-%m-%dT%H:%M:%S.%f}{zone}" for m in moments]
        columns["t"][7] = "yesterday"
        mapping = a_mapping(time={"unit": None, "format": form}, drive={"day": None})
        log = read_columns(tmp_path, columns, mapping)
        assert reasons(log) == [(8, "not_a_time", "time")]
    assert set(log.drives["day"].to_pylist()) == {date(2024, 2, 29)}
    assert ticks(log) == [i for i in range(20) if i != 7 or kind == "parquet"]


def test_a_time_zone_and_a_time_of_the_day_are_understood(tmp_path: Path) -> None:
    columns = {
        "t": [f"2024-07-01 10:00:00.{i:02d}" for i in range(100)],
        "clock": [f"10:00:00.{i:02d}" for i in range(100)],
        **dict.fromkeys(("ax", "beta"), [1] * 100),
    }
    zoned = {"unit": None, "format": "%Y-%m-%d %H:%M:%S%.f", "zone": "Europe/Berlin"}
    log = read_columns(tmp_path, columns, a_mapping(time=zoned, drive={"day": None}))
    assert log.drives["started_at"][0].as_py() == datetime(2024, 7, 1, 8, tzinfo=UTC)
    clock = {"column": "clock", "unit": None, "format": "%H:%M:%S%.f"}
    log = read_columns(tmp_path, columns, a_mapping(time=clock))
    assert log.drives["started_at"].null_count == log.counts.rows_kept == 100


def test_polars_does_not_warn_of_a_format_in_its_own_words(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    columns = good_columns()
    columns["t"] = [f"31.05.2024 12:00:00.{10 * i:03}" for i in range(len(columns["t"]))]
    mapping = a_mapping(time={"unit": None, "format": "%d.%m.%Y %H:%M:%S.%f"}, drive={"day": None})
    with pytest.raises(InputError, match="19 time_duplicate"):
        read_columns(tmp_path, columns, mapping)
    assert [warning for warning in recwarn if "%f" in str(warning.message)] == []


@pytest.mark.parametrize("rate_hz", [20, 50, 64, 100.4, 250, 1000])
def test_other_rates_are_resampled(tmp_path: Path, rate_hz: float) -> None:
    t = np.arange(int(4 * rate_hz)) / rate_hz + 17.3
    columns = {"t": t, "ax": 2 * (t - 17.3) - 3, "beta": 5 - t + 17.3}
    log = read_columns(tmp_path, {name: v.tolist() for name, v in columns.items()})
    start = 0.005 if rate_hz > 111 else 0.0
    time_s = np.array(ticks(log)) / 100 + start
    assert log.counts.drives_resampled == 1
    assert time_s[-1] == pytest.approx(4, abs=0.06)
    assert ticks(log) == list(range(len(time_s)))
    assert physical(log, "ax", 0.001) == pytest.approx(2 * time_s - 3, abs=5.1e-4)
    assert physical(log, "sideslip", 1e-4) == pytest.approx(np.radians(5 - time_s), abs=5.1e-5)


def test_side_slip_on_ticks_stays_as_measured(tmp_path: Path) -> None:
    columns = {"t": [0, 0.01, 0.02], "ax": [0] * 3, "beta": [179, -179, 183]}
    log = read_columns(tmp_path, columns)
    assert physical(log, "sideslip", 1e-4) == pytest.approx(np.radians([179, -179, 183]), abs=5e-5)


def test_side_slip_is_resampled_on_the_circle(tmp_path: Path) -> None:
    t = np.arange(100) / 50
    turning = np.degrees(np.angle(np.exp(1j * (3.0 + 2 * t))))  # spins through 180 degrees
    columns = {"t": t.tolist(), "ax": [0] * 100, "beta": turning.tolist()}
    log = read_columns(tmp_path, columns)
    time_s = np.array(ticks(log)) / 100
    error = np.angle(np.exp(1j * (physical(log, "sideslip", 1e-4) - 3.0 - 2 * time_s)))
    assert np.abs(error).max() < 1e-4


def test_a_rate_too_low_to_interpolate_leaves_what_was_measured(tmp_path: Path) -> None:
    columns = {"t": [0.5 * i for i in range(9)], "ax": [1] * 9, "beta": [1] * 9}
    assert ticks(read_columns(tmp_path, columns)) == list(range(0, 401, 50))
    columns["t"] = [0.003 * i for i in range(9)]
    with pytest.raises(InputError, match=r"longest_gap_s = 0\.001 prevents interpolation"):
        read_columns(tmp_path, columns, a_mapping(time={"longest_gap_s": 0.001}))


def test_absurd_numbers_of_drives_and_keys_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = good_columns(300)
    columns["run"] = [i // 3 for i in range(300)]
    monkeypatch.setattr(measured_log, "MAX_DRIVES", 99)
    with pytest.raises(InputError, match="splits into 100 drives of 3 rows on average"):
        read_columns(tmp_path, columns, a_mapping(drive={"column": "run"}))
    monkeypatch.setattr(checked_columns, "MAX_KEYS", 99)
    with pytest.raises(InputError, match="more than 99 combinations"):
        read_columns(tmp_path, columns, a_mapping(drive={"column": "run"}))
    columns["t"] = [10 * i for i in range(300)]
    monkeypatch.setattr(measured_log, "MAX_TICKS", 100)
    monkeypatch.setattr(measured_log, "MAX_TICKS_PER_ROW", 10)
    with pytest.raises(InputError, match="300 rows span 299,001 ticks"):
        read_columns(tmp_path, columns, a_mapping(time={"split_gap_s": 60, "longest_gap_s": 10}))


def test_the_result_depends_on_bytes_and_mapping_only(tmp_path: Path) -> None:
    text = csv_text(good_columns())
    first = read_text(tmp_path, text)
    (tmp_path / "elsewhere").mkdir()
    two = read_text(tmp_path / "elsewhere", text)
    assert first.digest == two.digest
    assert first.drives.equals(two.drives)
    assert read_text(tmp_path, text + "\n").digest != first.digest
    assert read_text(tmp_path, text, a_mapping(missing=["-"])).digest != first.digest


bad_rows = st.lists(
    st.tuples(
        st.integers(0, 40),
        st.sampled_from(
            ["oops,1,1", "0.1,x,1", "0.1,inf,1", "0.1,1,999", ",,", "nan,0,0", "0.1,,"]
        ),
    ),
    max_size=20,
)


@settings(max_examples=60)
@given(bad_rows)
def test_bad_rows_anywhere_leave_the_good_ones_as_they_are(
    tmp_path_factory: pytest.TempPathFactory, bad: list[tuple[int, str]]
) -> None:
    folder = tmp_path_factory.mktemp("rows")
    header, *lines = csv_text(good_columns(40)).splitlines()
    clean = read_text(folder, "\n".join([header, *lines]))
    for where, line in sorted(bad, reverse=True):
        lines.insert(where, line)
    log = read_text(folder, "\n".join([header, *lines]))
    assert without_names(log.drives).equals(without_names(clean.drives))
    positions = [i + 1 for i, line in enumerate(lines) if line in {text for _, text in bad}]
    assert log.quarantine["row"].to_pylist() == positions


@settings(max_examples=60)
@given(st.lists(st.tuples(st.integers(-30, 400), st.floats(-40, 40)), min_size=2, max_size=60))
def test_every_row_is_kept_or_quarantined(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[int, float]]
) -> None:
    t = [tick / 100 for tick, _ in rows]
    columns = {"t": t, "ax": [ax for _, ax in rows], "beta": [0] * len(rows)}
    try:
        log = read_columns(tmp_path_factory.mktemp("rows"), columns)
    except InputError:
        return
    assert log.counts.rows_read == len(rows)
    assert log.counts.rows_kept + sum(log.counts.quarantined.values()) == len(rows)
    assert log.quarantine.num_rows == sum(log.counts.quarantined.values())
    assert log.counts.ticks == log.drives.num_rows
    table = log.drives.select(["drive_id", "tick"]).to_pylist()
    keys = [(row["drive_id"], row["tick"]) for row in table]
    assert keys == sorted(set(keys))


@pytest.mark.parametrize(
    ("day", "accepted"),
    [("1969-12-31", False), ("1970-01-01", True), ("2199-12-31", True), ("2200-01-01", False)],
)
def test_days_of_two_centuries_are_kept(tmp_path: Path, day: str, accepted: bool) -> None:
    good = good_columns(20)
    columns = {**good, "d": ["2024-05-31"] * 10 + [day] * 10}
    log = read_columns(tmp_path, columns, a_mapping(drive={"day": {"column": "d"}}))
    assert log.counts.quarantined == ({} if accepted else {"out_of_range": 10})
    assert (date.fromisoformat(day) in log.drives["day"].to_pylist()) is accepted


def test_the_worked_example_of_the_docs(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "ingest.md").read_text(encoding="utf-8")
    log_text, mapping_text = (block.partition("\n")[2] for block in text.split("```")[1:4:2])
    (tmp_path / "m.toml").write_text(mapping_text)
    log = read_text(tmp_path, log_text, load_mapping(str(tmp_path / "m.toml"), CATALOG))
    assert reasons(log) == [(4, "out_of_range", "ay")]
    assert set(log.drives["vehicle_id"].to_pylist()) == {"A7"}
    g = 9.80665
    assert physical(log, "ax", 0.001) == pytest.approx([0.02 * g, 0.03 * g, 0.03 * g], abs=5e-4)
    assert physical(log, "ay", 0.001) == pytest.approx([0.01 * g, 0.01 * g, 0.02 * g], abs=5e-4)
    yaw_rate = np.radians([-0.25, -0.35, -0.35])
    assert physical(log, "yaw_rate", 1e-4) == pytest.approx(yaw_rate, abs=5e-5)
    assert physical(log, "wheel_fl", 0.01) == pytest.approx([64.10, 64.13, 64.17], abs=0.006)
    assert log.drives["sideslip"].to_pylist() == [None, 21, 23]
