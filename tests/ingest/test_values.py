"""Values as other programs write them: long numbers, grouped digits, NaN, second headers."""

from datetime import UTC, datetime, timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import h5py
import numpy as np
import polars as pl
import pytest

from fleet_slip.errors import InputError
from fleet_slip.ingest.logs import preview_logs
from fleet_slip.ingest.mapping import Mapping
from tests.support.measured import a_mapping, csv_text, read_measured, read_text, reasons

IDS = (1234567890123456785, 1234567890123456786, 1234567890123456799)
AX = {"ax": {"column": "ax", "unit": "m/s^2"}}


def cars() -> dict[str, Any]:
    """Return three cars in turns, of which each has 20 rows."""
    return {"t": np.repeat(np.arange(20) / 100, 3), "ax": np.tile([1.0, 2.0, 3.0], 20)}


@pytest.mark.parametrize("column", ["vehicle_id", "column"])
@pytest.mark.parametrize("kind", [pl.Int64, pl.UInt64, pl.Decimal(38, 0), pl.String])
def test_identifiers_keep_all_digits(tmp_path: Path, kind: Any, column: str) -> None:
    file = tmp_path / "log.parquet"
    numbers = pl.Series("id", IDS * 20, dtype=pl.Int64).cast(kind)
    pl.DataFrame(cars()).with_columns(numbers).write_parquet(file)
    drive = {"vehicle_id": {"column": "id"}} if column == "vehicle_id" else {"column": "id"}
    log = read_measured(file, a_mapping(signals=AX, drive=drive))
    name = "vehicle_id" if column == "vehicle_id" else "drive_name"
    values = zip(log.drives[name].to_pylist(), log.drives["ax"].to_pylist(), strict=True)
    assert set(values) == {(str(number), 1000 * (i + 1)) for i, number in enumerate(IDS)}


def test_identifiers_of_hdf5_keep_all_digits(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in (cars() | {"id": np.array(IDS * 20)}).items():
            file[name] = values
    log = read_measured(
        tmp_path / "log.h5", a_mapping(signals=AX, drive={"vehicle_id": {"column": "id"}})
    )
    assert set(log.drives["vehicle_id"].to_pylist()) == set(map(str, IDS))


def test_identifiers_that_a_float_has_rounded_are_refused(tmp_path: Path) -> None:
    table = pl.DataFrame(cars()).with_columns(id=pl.Series([*IDS[:2], 7] * 20, dtype=pl.Float64))
    table.write_parquet(tmp_path / "log.parquet")
    mapping = a_mapping(signals=AX, drive={"vehicle_id": {"column": "id"}})
    log = read_measured(tmp_path / "log.parquet", mapping)
    assert set(log.drives["vehicle_id"].to_pylist()) == {"7"}
    assert log.counts.quarantined == {"out_of_range": 40}


def test_conditions_on_long_numbers_and_decimals_as_signals(tmp_path: Path) -> None:
    table = (
        pl.DataFrame(cars())
        .filter(pl.col("ax") == 2)
        .with_columns(ax=pl.lit(Decimal("2.50")), frame=pl.Series([*IDS[:2]] * 10))
    )
    table.write_parquet(tmp_path / "log.parquet")
    where = [{"column": "frame", "one_of": [str(IDS[1])]}]
    log = read_measured(tmp_path / "log.parquet", a_mapping(signals=AX, where=where))
    assert log.drives["ax"].to_pylist() == [2500] * 19  # on ticks between rows, too


def german(**drive: Any) -> Mapping:
    layout = {"separator": ";", "decimal_comma": True}
    return a_mapping(signals=AX, csv=layout, drive=drive)


def test_points_group_digits_beside_a_decimal_comma(tmp_path: Path) -> None:
    rows = [f"0,{i:02};{v};1.320" for i, v in enumerate(["1,5", "-12,25", "0,5", "2", "10"])]
    log = read_text(tmp_path, "\n".join(["t;ax;m", *rows]), german(mass_kg={"column": "m"}))
    assert log.drives["mass_kg"].to_pylist() == [1320.0] * 5
    assert log.drives["ax"].to_pylist() == [1500, -12250, 500, 2000, 10000]
    grouped = {
        "-1.000,5": "out_of_range", "1.234.567": "out_of_range", "1.000,5": "out_of_range",
        "0.5": "not_a_number", "1.5": "not_a_number", "12.3456": "not_a_number",
        "1,000.5": "not_a_number", "1.0005,5": "not_a_number", "0.320": "not_a_number",
    }  # fmt: skip
    rows = [f"0,{i:02};{v};1" for i, v in enumerate(["1", *grouped, "2"])]
    log = read_text(tmp_path, "\n".join(["t;ax;m", *rows]), german())
    assert [reason for _, reason, _ in reasons(log)] == [*grouped.values()]


def test_grouped_digits_of_quoted_fields_are_no_numbers(tmp_path: Path) -> None:
    text = 't,ax\n0,1\n0.01,"1,320"\n0.02,"1,5"\n0.03,2\n'
    log = read_text(tmp_path, text, a_mapping(signals=AX))
    assert [row[1] for row in reasons(log)] == ["not_a_number"] * 2


HEADER, ROWS = "t,ax,beta", [f"{i / 100},{i % 7},0.5" for i in range(100)]
SWAPPED = [f"0.5,{i / 100},{i % 7}" for i in range(100, 200)]


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        ("t,ax,beta", [f"{i / 100},{i % 7},0.5" for i in range(100, 200)]),
        ("beta,t,ax", SWAPPED),
        ('"beta",t, ax', SWAPPED),
        ("new,beta,t,ax", [f"8,{row}" for row in SWAPPED]),
        ("beta,t,ax,new", [f"{row},8" for row in SWAPPED]),
    ],
)
@pytest.mark.parametrize("block_bytes", [2**22, 200])
def test_a_second_header_gives_the_places_of_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header: str, rows: list[str], block_bytes: int
) -> None:
    monkeypatch.setattr("fleet_slip.ingest.formats.csv.BLOCK_BYTES", block_bytes)
    log = read_text(tmp_path, "\n".join([HEADER, *ROWS, header, *rows]))
    assert log.drives["ax"].to_pylist() == [1000 * (i % 7) for i in range(200)]
    assert set(log.drives["sideslip"].to_pylist()) == {87}
    assert [row[0] for row in reasons(log)] == [101]


def test_a_second_header_without_a_mapped_column_refuses_the_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no column 'ax'"):
        read_text(tmp_path, "\n".join([HEADER, *ROWS, "t,beta,gamma", *SWAPPED]))


@pytest.mark.parametrize("text", ["NaN", "nan", "-nan", "-nan(ind)", "1.#QNAN", "-1.#IND", "+NaN"])
def test_nan_is_a_missing_value_of_its_signal(tmp_path: Path, text: str) -> None:
    columns = {"t": np.arange(5) / 100, "ax": [1, text, 3, text, 5], "beta": [0.5] * 5}
    log = read_text(tmp_path, csv_text(columns))
    assert log.drives["ax"].to_pylist() == [1000, None, 3000, None, 5000]
    assert log.drives["sideslip"].to_pylist() == [87] * 5
    assert log.counts.quarantined == {}


def test_nan_of_parquet_is_missing_and_infinity_is_refused(tmp_path: Path) -> None:
    table = {"t": np.arange(4) / 100, "ax": [1.0, np.nan, np.inf, 2.0], "beta": np.zeros(4)}
    pl.DataFrame(table).write_parquet(tmp_path / "log.parquet")
    log = read_measured(tmp_path / "log.parquet", a_mapping())
    assert log.counts.rows_kept == 3
    assert log.counts.quarantined == {"not_finite": 1}


def test_the_hour_that_comes_twice_is_read_in_its_order(tmp_path: Path) -> None:
    start = datetime(2024, 10, 27, 0, 30, tzinfo=UTC)
    moments = [start + timedelta(seconds=i / 2) for i in range(2 * 7200)]
    texts = [f"{m.astimezone(ZoneInfo('Europe/Berlin')):%Y-%m-%d %H:%M:%S.%f}" for m in moments]
    time = {"unit": None, "format": "%Y-%m-%d %H:%M:%S%.f", "zone": "Europe/Berlin"}
    slow = {"longest_gap_s": 2, "split_gap_s": 5}
    mapping = a_mapping(time=time | slow, drive={"day": None}, signals=AX)
    columns = {"t": texts, "ax": np.arange(len(texts)) % 5}
    log = read_text(tmp_path, csv_text(columns), mapping)
    assert log.counts.quarantined == {}
    assert log.counts.rows_kept == len(texts)
    started = [moment.astimezone(UTC) for moment in log.drives["started_at"].unique().to_pylist()]
    assert min(started) == start
    assert (max(started) - start).total_seconds() < 7200
    assert log.counts.ticks == pytest.approx(100 * 7200, rel=0.01)


def test_times_of_the_day_may_lack_noughts(tmp_path: Path) -> None:
    for written, times in (
        ("%H%M%S%.f", ["95958.5", "95959", "95959.5", "100000"]),
        ("%H:%M:%S%.f", ["9:59:58.5", "9:59:59", "9:59:59.5", "10:00:00"]),
    ):
        time = {"unit": None, "format": written, "longest_gap_s": 1}
        columns = {"t": times, "ax": [1, 2, 3, 4]}
        log = read_text(tmp_path, csv_text(columns), a_mapping(time=time, signals=AX))
        assert (log.counts.rows_kept, log.counts.drives) == (4, 1)


def faults_of(folder: Path, columns: dict[str, Any], mapping: Mapping) -> list[str]:
    """Return what looks wrong in a CSV file."""
    (folder / "log.csv").write_text(csv_text(columns))
    (preview,) = preview_logs([folder / "log.csv"], mapping)
    assert all(fault.does_harm for fault in preview.suspicions)
    return [str(fault) for fault in preview.suspicions]


def test_an_implausible_rate_is_reported(tmp_path: Path) -> None:
    columns = {"t": np.arange(3000) / 100, "ax": np.sin(np.arange(3000) / 50)}
    fast = faults_of(tmp_path, columns, a_mapping(time={"unit": "ms"}, signals=AX))
    assert fast == ["implausible time? 100.0 kHz. Check the unit of time in the mapping."]
    assert faults_of(tmp_path, columns, a_mapping(signals=AX)) == []


@pytest.mark.parametrize(
    ("days", "why"),
    [
        (-7168, "1024 weeks before the file was written"),
        (-11_000, "before 2000-01-01"),
        (40, "in the future"),
        (-2000, ""),
    ],
)
def test_a_day_that_cannot_be_is_reported(tmp_path: Path, days: int, why: str) -> None:
    start_s = datetime.now(UTC).timestamp() + 86_400 * days
    columns = {"t": start_s + np.arange(500) / 100, "ax": np.sin(np.arange(500) / 50)}
    mapping = a_mapping(time={"epoch": True}, drive={"day": None}, signals=AX)
    faults = faults_of(tmp_path, columns, mapping)
    assert len(faults) == bool(why)
    assert all(f.startswith("implausible day? 1 drive: ") and why in f for f in faults)
