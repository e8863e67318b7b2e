"""The same rows and drives, in whatever blocks a file is read; plain numbers as by way of text."""

import threading
from datetime import date
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.catalog.counts import as_arrow
from fleet_slip.compute.tasks import AHEAD, read_ahead
from fleet_slip.errors import InputError
from fleet_slip.ingest import checked_columns, drives, logs, measured_log
from fleet_slip.ingest.drives import DriveCutter, DriveSamples
from fleet_slip.ingest.formats import csv as csv_batches
from fleet_slip.ingest.formats.csv import CsvSource
from fleet_slip.ingest.formats.file_formats import CsvFormat, PlainNumbers
from fleet_slip.ingest.formats.source import Budget
from fleet_slip.ingest.logs import log_table
from fleet_slip.ingest.measured_log import open_measured
from fleet_slip.ingest.ticks import MeasuredDrive
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.measured import (
    a_mapping,
    csv_text,
    good_columns,
    ingest_file,
    read_columns,
    read_measured,
    ticks,
)

times = st.lists(
    st.tuples(
        st.integers(0, 2),
        st.one_of(st.integers(0, 60).map(lambda i: i / 100), st.sampled_from([7.0, 1e300, -9.0])),
    ),
    min_size=1,
    max_size=40,
)


def cut(
    rows: list[tuple[int, float]], sizes: list[int], longest_s: float
) -> tuple[list[list[int]], list[tuple[int, str]]]:
    """The rows of each drive, in the order in which they end; and the refused ones."""
    refused: list[pl.DataFrame] = []
    cutter = DriveCutter(a_mapping().time.split_gap_s, refused.append)
    frame = pl.DataFrame(
        {
            "row": range(1, len(rows) + 1),
            "group": pl.Series([group for group, _ in rows], dtype=pl.Int32),
            "time": [time for _, time in rows],
        }
    ).sort("group", maintain_order=True)
    ended: list[DriveSamples] = []
    at = 0
    with mock.patch.object(drives, "MAX_DRIVE_S", longest_s):
        for size in [*sizes, len(rows)]:
            ended += cutter.cut(frame.slice(at, size))
            at += size
        ended += cutter.end_group()
    bad = [row for rows in refused for row in rows.select("row", "reason").iter_rows()]
    return [drive.frame["row"].to_list() for drive in ended], sorted(bad)


@settings(max_examples=60)
@given(times, st.lists(st.integers(1, 9), max_size=12), st.sampled_from([0.05, 0.2, 1e9]))
def test_blocks_change_nothing(
    rows: list[tuple[int, float]], sizes: list[int], longest_s: float
) -> None:
    expected = cut(rows, [], longest_s)
    assert cut(rows, sizes, longest_s) == expected
    rows_of_drives = [row for part in expected[0] for row in part]
    assert sorted(rows_of_drives + [row for row, _ in expected[1]]) == list(range(1, len(rows) + 1))
    for part in expected[0]:
        moments = [rows[row - 1][1] for row in part]
        assert moments == sorted(set(moments))
        assert moments[-1] - moments[0] < longest_s
        assert len({rows[row - 1][0] for row in part}) == 1


def test_a_drive_that_lasts_too_long_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drives, "MAX_DRIVE_S", 0.5)
    monkeypatch.setattr(drives, "MAX_DRIVE_ROWS", 50)
    log = read_columns(tmp_path, good_columns(60))
    name = f"test-{log.digest[:12]}-1"
    assert log.drives["drive_id"].to_pylist() == [name] * 50 + [f"{name}-2"] * 10
    assert ticks(log) == [*range(50), *range(10)]
    fast = {"t": [i / 1000 for i in range(600)], "ax": [1] * 600, "beta": [1] * 600}
    assert read_columns(tmp_path, fast).counts.drives == 12


@pytest.mark.parametrize(("limit", "files"), [(1, 3), (40, 2), (10_000, 1)])
def test_stored_rows_do_not_depend_on_the_size_of_data_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int, files: int
) -> None:
    monkeypatch.setattr(logs, "FILE_ROWS", limit)
    monkeypatch.setattr(measured_log, "MAX_REJECTED_IN_MEMORY", limit)
    columns = good_columns(90)
    columns["t"] = [f"{i / 100 + 5 * (i // 30):.2f}" for i in range(90)]
    columns["ax"][3] = columns["ax"][70] = "x"
    (tmp_path / "log.csv").write_text(csv_text(columns))
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    report = ingest_file(warehouse, tmp_path / "log.csv", a_mapping())
    assert (report.counts.drives, report.counts.ticks) == (3, 88)
    stored, refused = (
        pa.concat_tables(table.read(file.path) for file in table.snapshot().files)
        for table in (warehouse.logs, warehouse.quarantine)
    )
    assert len(warehouse.logs.snapshot().files) == files
    expected = read_measured(tmp_path / "log.csv", a_mapping())
    order = [("drive_id", "ascending"), ("tick", "ascending")]
    stored = stored.set_column(0, "drive_id", stored["drive_id"].cast(pa.string())).sort_by(order)
    assert stored["ax"].to_pylist() == expected.drives["ax"].to_pylist()
    assert sorted(refused["row"].to_pylist()) == [4, 71]
    assert not ingest_file(warehouse, tmp_path / "log.csv", a_mapping()).new


@pytest.mark.parametrize("threads", [1, 4])
@pytest.mark.parametrize("block_bytes", [200, 2**22])
def test_the_bits_that_land_depend_on_neither_threads_nor_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: int, block_bytes: int
) -> None:
    columns = good_columns(120)
    columns["t"] = [f"{i / 100 + 5 * (i // 30):.2f}" for i in range(120)]
    columns["ax"][70] = "broken"
    (tmp_path / "log.csv").write_text(csv_text(columns))
    monkeypatch.setattr(logs, "FILE_ROWS", 50)
    expected = _land_in(tmp_path / "as it is", tmp_path / "log.csv")
    monkeypatch.setattr(logs, "WRITERS", threads)
    monkeypatch.setattr(csv_batches, "BLOCK_BYTES", block_bytes)
    assert _land_in(tmp_path / "otherwise", tmp_path / "log.csv") == expected
    assert len(expected) == 3  # 4 drives in two files, and the quarantine


def _land_in(root: Path, file: Path) -> list[str]:
    """Return the names of the data files, which have the checksums of what is in them."""
    warehouse = Warehouse(LocalFolder(root))
    ingest_file(warehouse, file, a_mapping())
    tables = (warehouse.logs, warehouse.quarantine)
    return sorted(data_file.path for table in tables for data_file in table.snapshot().files)


def test_nothing_is_left_of_a_file_that_fails_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "FILE_ROWS", 1)
    monkeypatch.setattr(csv_batches, "BLOCK_BYTES", 100)
    columns = good_columns(90)
    columns["t"] = [f"{i / 100 + 5 * (i // 30):.2f}" for i in range(90)]
    (tmp_path / "log.csv").write_bytes(csv_text(columns).encode() + b"0.1,\xff,1\n")
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    with pytest.raises(InputError, match="not UTF-8"):
        ingest_file(warehouse, tmp_path / "log.csv", a_mapping())
    assert not list((tmp_path / "data").rglob("*.parquet"))


@pytest.mark.parametrize("values", [0, 200, 2**20])
def test_drives_that_alternate_are_the_same_sorted_in_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, values: int
) -> None:
    """Drives that alternate row by row, of which one ends early, and one that stands together."""
    columns: dict[str, list[Any]] = {**good_columns(60)}
    columns["run"] = [i % 3 if i < 45 else 9 for i in range(60)]
    columns["t"] = [f"{i / 100 + 5 * (i % 3 == 1 and i > 20):.2f}" for i in range(60)]
    columns["ax"][7] = "x"
    monkeypatch.setattr(csv_batches, "BLOCK_BYTES", 200)
    mapping = a_mapping(drive={"column": "run"}, time={"longest_gap_s": 0.1})
    expected = read_columns(tmp_path, columns, mapping)
    monkeypatch.setattr(drives, "MAX_VALUES_IN_MEMORY", values)
    spilled = read_columns(tmp_path, columns, mapping)
    assert spilled.drives.equals(expected.drives)
    assert spilled.counts == expected.counts
    assert expected.counts.drives == 5


@pytest.mark.parametrize("returns", [False, True])
@pytest.mark.parametrize("block_bytes", [200, 2**22])
def test_drives_whose_rows_are_together_end_with_their_last_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int, *, returns: bool
) -> None:
    """Three drives: the second has a gap, and the third an isolated last row."""
    columns: dict[str, list[Any]] = {**good_columns(60)}
    columns["run"] = [f"run {i // 20}" for i in range(60)]
    columns["t"] = [f"{i / 100 + 5 * (28 < i < 40) + 9 * (i == 59):.2f}" for i in range(60)]
    columns["ax"][7] = columns["run"][9] = ""
    if returns:
        columns["run"][58] = " run 0"
    mapping = a_mapping(drive={"column": "run"})
    expected = read_columns(tmp_path, columns, mapping)
    monkeypatch.setattr(csv_batches, "BLOCK_BYTES", block_bytes)
    monkeypatch.setattr(checked_columns, "LARGE_FILE_BYTES", 0)
    together = read_columns(tmp_path, columns, mapping)
    assert checked_columns.is_grouped(tmp_path / "log.csv", mapping) != returns
    assert together.drives.equals(expected.drives)
    assert together.quarantine.equals(expected.quarantine)
    assert together.counts == expected.counts
    assert expected.counts.drives == 4
    assert expected.counts.quarantined["isolated"] == 1
    with open_measured(tmp_path / "log.csv", mapping) as stream:
        names = [drive.drive_id for drive in stream.drives()]
    assert returns or names == sorted(names)


numbers = st.one_of(
    st.floats().map(str),
    st.integers().map(str),
    st.sampled_from(["", " 1", "1 ", "+1", "1.", ".5", "-.5", "1e5", "1E+5", "1_0", "0x1", "inf"]),
    st.sampled_from(["nan", "NaN", "-99", "-99.0", "1,5", "1,5,2", "1.5,2", "true", "1d", "--1"]),
    st.text("0123456789.eE+- ", max_size=9),
)


@settings(max_examples=60)
@given(st.lists(numbers, min_size=1, max_size=6), st.booleans())
def test_plain_numbers_are_those_of_their_texts(
    tmp_path_factory: pytest.TempPathFactory, texts: list[str], comma: bool
) -> None:
    file = tmp_path_factory.mktemp("numbers") / "log.csv"
    file.write_text("a;b\n" + "".join(f"{text};x\n" for text in texts))
    form = CsvFormat(separator=";", decimal_comma=comma)

    def read(plain: PlainNumbers) -> pl.Series:
        return pl.concat(CsvSource(Budget.for_file(file), form, plain).batches(["a"]))["a"]

    fast = read(PlainNumbers(frozenset({"a"}), (-99.0, float("nan"))))
    parsed = read(PlainNumbers())
    if fast.dtype == pl.String:
        assert fast.equals(parsed)
        return
    plain = parsed.str.strip_chars()
    plain = plain.str.replace(",", ".", literal=True) if comma else plain
    expected = plain.cast(pl.Float64, strict=False)
    assert fast.to_numpy().tobytes() == expected.to_numpy().tobytes()
    assert np.isfinite(fast.to_numpy()).all()


def test_items_are_read_ahead_in_order_and_errors_come_in_their_place() -> None:
    taken: list[int] = []

    def items() -> Any:
        for i in range(4):
            taken.append(i)
            yield i
        raise ValueError("end")

    ahead = read_ahead(items())
    assert next(ahead) == 0
    assert next(ahead) == 1
    ahead.close()
    assert taken == list(range(len(taken)))
    assert len(taken) <= 2 + AHEAD
    seen = []
    with pytest.raises(ValueError, match="end"):
        for item in read_ahead(items()):
            seen.append(item)
    assert seen == [0, 1, 2, 3]
    assert not [t for t in threading.enumerate() if t.name.startswith("read-ahead")]


def drive(name: str, rows: int) -> MeasuredDrive:
    """Return a drive whose car is called like it, with `ax` in the order of its ticks."""
    ticks = np.arange(rows, dtype=np.int32)
    facts = {"drive_id": name, "vehicle_id": f"car of {name}", "day": date(2024, 5, 31)}
    metadata = {**facts, "rows": rows, "track": None}
    return MeasuredDrive(name, metadata, "snap", ticks, {"ax": as_arrow(ticks.astype(np.int16))})


@pytest.mark.parametrize("sizes", [[5], [1, 2, 3], [0, 4]])
def test_every_row_says_what_is_known_of_its_drive(sizes: list[int]) -> None:
    drives = [drive(f"drive {i}", rows) for i, rows in enumerate(sizes)]
    table = log_table(drives, a_mapping(signals={"ax": {"column": "ax", "unit": "m/s^2"}}))
    rows = [(drive_, tick) for drive_ in drives for tick in drive_.ticks.tolist()]
    for column in ("drive_id", "vehicle_id", "rows", "day", "track"):
        assert table[column].to_pylist() == [drive_.metadata[column] for drive_, _ in rows]
    assert table["tick"].to_pylist() == [tick for _, tick in rows]
    assert pa.types.is_dictionary(table["drive_id"].type)
    assert table["vx"].null_count == len(rows)
