import errno
import gzip
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_slip.catalog.counts import as_arrow
from fleet_slip.errors import InputError
from fleet_slip.ingest import batches
from fleet_slip.ingest import checked_columns as checking
from fleet_slip.ingest.formats import csv as csv_batches
from fleet_slip.ingest.formats import source
from fleet_slip.ingest.formats.csv import BLOCK_BYTES
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.reading import open_source
from fleet_slip.ingest.formats.source import Budget, Spool
from fleet_slip.ingest.formats.tables import open_parquet
from tests.support.logs import without_names
from tests.support.measured import (
    a_mapping,
    csv_text,
    failure,
    good_columns,
    read_measured,
    read_text,
    reasons,
    ticks,
)

GOOD = csv_text(good_columns())


def write(folder: Path, data: bytes, name: str = "log.csv") -> Path:
    file = folder / name
    file.write_bytes(data)
    return file


@pytest.mark.parametrize(
    "change",
    [
        lambda text: b"\xef\xbb\xbf" + text,
        lambda text: text.replace(b"\n", b"\r\n"),
        lambda text: text.rstrip(),
        lambda text: text.replace(b",", b" , "),
        lambda text: b"\n".join(b'"' + line.replace(b",", b'","') + b'"' for line in text.split()),
        lambda text: text.replace(b"\n", b",\n"),  # a separator at each line's end
        lambda text: text.replace(b"\n", b",\xc3\xa9\n"),
    ],
    ids=["bom", "crlf", "no final newline", "blanks", "quoted", "trailing separator", "utf-8"],
)
def test_dialects_read_alike(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    plain = without_names(read_text(tmp_path, GOOD).drives)
    other = without_names(read_text(tmp_path, change(GOOD.encode())).drives)
    assert other.equals(plain)


def test_semicolons_and_decimal_commas(tmp_path: Path) -> None:
    mapping = a_mapping(csv={"separator": ";", "decimal_comma": True})
    text = GOOD.replace(",", ";").replace(".", ",")
    got = without_names(read_text(tmp_path, text, mapping).drives)
    assert got.equals(without_names(read_text(tmp_path, GOOD).drives))


def test_blocks_are_cut_at_lines_and_not_within_quotes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = good_columns(200)
    columns["note"] = ['"a\nb ""c""\n"' if i % 3 else "é" for i in range(200)]
    text = csv_text(columns)
    expected = read_text(tmp_path, text)
    for size in (32, 61, 100):
        monkeypatch.setattr(csv_batches, "BLOCK_BYTES", size)
        pieces = read_text(tmp_path, text)
        assert pieces.drives.equals(expected.drives)
        assert pieces.counts == expected.counts
    assert ticks(expected) == list(range(200))


def test_a_line_with_more_fields_than_the_header_is_quarantined(tmp_path: Path) -> None:
    lines = GOOD.splitlines()
    lines[4] += ",7,8,9"
    log = read_text(tmp_path, "\n".join(lines))
    assert reasons(log) == [(4, "extra_fields", None)]
    assert log.quarantine["value"].to_pylist() == ["7"]


@pytest.mark.parametrize(
    ("end", "reason", "signal"), [("0.2,1", "cut_line", None), ("0.2", "no_value", None)]
)
def test_a_last_line_that_is_cut_is_quarantined(
    tmp_path: Path, end: str, reason: str, signal: str | None
) -> None:
    log = read_text(tmp_path, GOOD.rstrip() + "\n" + end)
    assert reasons(log) == [(21, reason, signal)]
    assert ticks(log) == list(range(20))


def test_a_last_line_that_is_as_short_as_others_is_whole(tmp_path: Path) -> None:
    head, first, *lines = GOOD.splitlines()
    log = read_text(tmp_path, "\n".join([head + ",note", first + ",on", *lines]))
    assert log.counts.quarantined == {}
    assert len(ticks(log)) == 20


@pytest.mark.parametrize("header", ["t,new,ax,beta", "t,ax,beta,note"])
def test_rows_with_fewer_fields_than_names_are_refused(tmp_path: Path, header: str) -> None:
    text = GOOD.replace("t,ax,beta", header)
    with pytest.raises(InputError, match="its header has 4 names, and its rows have 3 fields"):
        read_text(tmp_path, text)
    assert read_text(tmp_path, GOOD.replace("t,ax,beta", "t,ax,beta,,")).counts.rows_kept == 20


def test_columns_of_one_name_have_numbers(tmp_path: Path) -> None:
    rows = [f"{i / 100},{i},8,9,0.5" for i in range(20)]
    text = "\n".join(["t,ax,x,x,beta", *rows])
    assert read_text(tmp_path, text).counts.rows_kept == 20
    second = {"ax": {"column": "x@4", "unit": "m/s^2"}}
    assert set(read_text(tmp_path, text, a_mapping(signals=second)).drives["ax"].to_pylist()) == {
        9000
    }


def test_the_header_of_racecapture_has_names_and_units(tmp_path: Path) -> None:
    header = '"Interval"|"ms"|0|0|1,"Utc"|"ms"|0|0|1,"AccelX"|"G"|-3.0|3.0|25,"Yaw"|"Deg/s"|-9|9|2'
    rows = [f"{10 * i},{1717156800000 + 10 * i},0.1,{i % 30}" for i in range(50)]
    signals = {
        "ax": {"column": "AccelX", "unit": "g"},
        "yaw_rate": {"column": "Yaw", "unit": "deg/s"},
    }
    mapping = a_mapping(time={"column": "Interval", "unit": "ms"}, signals=signals)
    log = read_text(tmp_path, "\n".join([header, *rows]), mapping)
    assert set(log.drives["ax"].to_pylist()) == {981}
    with open_source(tmp_path / "log.csv", FileFormats()) as opened:
        assert [channel.unit for channel in opened.channels()] == ["ms", "ms", "G", "Deg/s"]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "its line 1 is no header of CSV"),
        (b"\n\n", "its line 1 is no header of CSV"),
        (b"t,ax,beta\n", "a header without rows"),
        (b"t,ax,ax,beta\n0,1,2,3\n", "2 columns are called 'ax'. Map one of 'ax@2', 'ax@3'"),
        (b"t,AX,beta_deg\n0,1,2\n", "no column 'ax'. Did the mapping mean 'AX'? Its columns are"),
        (b"t,ax,beta\n0,1\xe92,3\n", "not UTF-8, near"),
        ("t,ax,beta\n0,1,2\n".encode("utf-16"), "binary or UTF-16"),
        (b"\x1f\x8b\x08\x00" + b"\xab" * 50, "cannot be read"),
        (b"t" * 2_000_000, "its line 1 is no header of CSV"),
        (b"t,ax,beta" + b",x" * 20_000 + b"\n", "20,003 columns, at most 10,000"),
        (b't,ax,"beta\n0,1,2\n', "its line 1 is no header of CSV"),
        (b't,ax,beta\n0,1,"2\n0.01,3,4\n', "cannot be read"),
        (b"t,ax,beta\n" + b"x,y,z\n" * 9, "none of 9 rows is usable (9 not_a_number; first: "),
    ],
)
def test_broken_csv_is_refused_in_one_line(tmp_path: Path, data: bytes, message: str) -> None:
    assert message in failure(write(tmp_path, data))


def test_a_line_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_batches, "BLOCK_BYTES", 1000)
    data = b't,ax,beta\n0,1,"' + b"2\n" * 5000
    assert "Is a quote not closed?" in failure(write(tmp_path, data))


def test_paths_that_are_no_files_are_refused(tmp_path: Path) -> None:
    assert "no such file" in failure(tmp_path / "absent.csv")
    assert "not a regular file" in failure(tmp_path)
    os.mkfifo(tmp_path / "pipe.csv")
    assert "not a regular file" in failure(tmp_path / "pipe.csv")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert "no such file" in failure(tmp_path / "loop")


def test_a_file_that_grows_while_it_is_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write(tmp_path, GOOD.encode())

    read = batches.read_batches

    def grow(*arguments: Any) -> Any:
        yield from read(*arguments)
        file.write_bytes(GOOD.encode() + b"0.20,1,1\n")

    monkeypatch.setattr(checking, "read_batches", grow)
    assert "it changed while it was read" in failure(file)


@pytest.mark.parametrize("name", ["*.csv", "a\nb'.csv", "x'; DROP TABLE logs; --", "é.csv"])
def test_a_file_name_is_only_a_name(tmp_path: Path, name: str) -> None:
    log = read_measured(write(tmp_path, GOOD.encode() + b"oops,1,2\n", name), a_mapping())
    assert log.quarantine["file"].to_pylist() == [name]
    failure(tmp_path / (name + "absent"))


@pytest.mark.parametrize("name", ["^.*$", "*", "raw t", "'; DROP TABLE logs; --", "a.b", "row"])
def test_a_column_name_is_only_a_name(tmp_path: Path, name: str) -> None:
    columns: dict[str, Any] = good_columns()
    columns[name] = columns.pop("ax")
    mapping = a_mapping(signals={"ax": {"column": name, "unit": "m/s^2"}})
    log = read_text(tmp_path, csv_text(columns), mapping)
    assert log.drives["ax"].to_pylist()[:2] == [-1000, -900]
    table = pa.table({key: np.array(values, dtype=float) for key, values in columns.items()})
    pq.write_table(table, tmp_path / "log.parquet")
    binary = read_measured(tmp_path / "log.parquet", mapping)
    assert binary.drives["ax"].equals(log.drives["ax"])


def parquet(folder: Path, **columns: Any) -> Path:
    table = {"t": np.arange(20) / 100, "ax": np.ones(20), "beta": np.ones(20), **columns}
    pq.write_table(pa.table(table), folder / "log.parquet")
    return folder / "log.parquet"


def test_parquet_types_that_are_numbers(tmp_path: Path) -> None:
    integers = pa.array(range(20))
    for numbers in (
        integers.cast(pa.int8()),
        integers.cast(pa.uint64()),
        integers.cast(pa.float32()),
        integers.cast(pa.decimal128(21, 2)),
        integers.cast(pa.string()),
        integers.cast(pa.large_string()),
        integers.dictionary_encode(),
        integers.cast(pa.string()).dictionary_encode(),
    ):
        log = read_measured(parquet(tmp_path, ax=numbers), a_mapping())
        assert log.drives["ax"].to_pylist() == [1000 * i for i in range(20)]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (pa.array([True] * 20), "has the type bool"),
        (pa.array([{"b": 1}] * 20), "has the type struct"),
        (pa.array([[1.0]] * 20), "has the type list"),
        (pa.array([b"1"] * 20), "has the type binary"),
        (pa.array([1] * 20, pa.timestamp("ms")), "the mapping needs numbers"),
        (pa.array(["9" * 5000] * 20), "texts of 5,000 characters"),
    ],
)
def test_parquet_types_that_are_no_numbers(tmp_path: Path, values: pa.Array, message: str) -> None:
    assert message in failure(parquet(tmp_path, ax=values))


def test_an_all_null_column_is_an_absent_signal(tmp_path: Path) -> None:
    log = read_measured(parquet(tmp_path, ax=pa.nulls(20)), a_mapping())
    assert log.drives["ax"].null_count == 20
    assert log.counts.rows_kept == 20


def test_broken_parquet_is_refused(tmp_path: Path) -> None:
    data = parquet(tmp_path).read_bytes()
    assert "Is it complete?" in failure(write(tmp_path, data[:-20], "cut.parquet"))
    assert "Is it complete?" in failure(write(tmp_path, data[:4]))
    assert "not a Parquet file" in failure(write(tmp_path, GOOD.encode(), "text.parquet"))
    assert "its footer has more than" in failure(write(tmp_path, b"PAR1" + b"\xff" * 20 + b"PAR1"))
    assert "cannot be read" in failure(write(tmp_path, b"PAR1\0\0\0\0\x04\0\0\0PAR1"))


def test_text_in_parquet_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    data = parquet(tmp_path, ax=pa.array(["needle"] * 20)).read_bytes()
    assert "UTF8" in failure(write(tmp_path, data.replace(b"needle", b"\xffeedle"), "bad.parquet"))


@pytest.mark.parametrize(
    "column",
    [
        pa.array([2**52, 0], pa.timestamp("s")),
        pa.array([-(2**62), 0], pa.timestamp("us", tz="UTC")),
        pa.array([-(2**31), 0], pa.date32()),
        pa.array([2**62, 0], pa.date64()),
    ],
)
def test_a_time_beyond_the_calendar_is_no_time(
    tmp_path: Path, column: pa.Array, capfd: pytest.CaptureFixture[str]
) -> None:
    table = pa.table({"time": column})
    file = tmp_path / "log.parquet"
    pq.write_table(table, file)
    with open_parquet(Budget.for_file(file)) as source:
        (batch,) = source.batches(["time"])
    assert [value is None for value in batch["time"]] == [True, False]
    assert capfd.readouterr().err == ""


def test_a_row_group_that_is_a_whole_file_is_not_in_memory_as_a_whole(tmp_path: Path) -> None:
    rows = 2_000_000
    values = np.random.default_rng(0).random(rows)
    columns = pa.table({"ax": as_arrow(values)})
    pq.write_table(columns, tmp_path / "log.parquet", row_group_size=rows, use_dictionary=False)
    with open_parquet(Budget.for_file(tmp_path / "log.parquet")) as source:
        before = pa.total_allocated_bytes()
        batches = source.batches(["ax"])
        next(batches)
        assert pa.total_allocated_bytes() - before < values.nbytes / 2


TEXT = csv_text(good_columns(200)).encode()


def zstd(text: bytes) -> bytes:
    return bytes(pa.compress(text, "zstd", asbytes=True))


both = pytest.mark.parametrize("compress", [gzip.compress, zstd], ids=["gzip", "zstd"])
Compress = Callable[[bytes], bytes]


def refusal(folder: Path, content: bytes) -> str:
    file = folder / "log.csv.gz"
    file.write_bytes(content)
    return failure(file, a_mapping())


@both
def test_compressed_text_gives_the_same_counts_under_any_name(
    tmp_path: Path, compress: Compress
) -> None:
    plain = without_names(read_text(tmp_path, TEXT).drives)
    assert without_names(read_text(tmp_path, compress(TEXT)).drives).equals(plain)


@both
def test_a_truncated_file_is_no_shorter_drive(tmp_path: Path, compress: Compress) -> None:
    content = compress(TEXT)
    for length in (len(content) // 2, len(content) - 1):
        assert "Truncated compressed stream" in refusal(tmp_path, content[:length])


def test_a_flipped_bit_is_noticed_by_the_checksum_of_gzip(tmp_path: Path) -> None:
    content = bytearray(gzip.compress(TEXT))
    content[-6] ^= 1  # in the CRC-32
    assert "cannot be read" in refusal(tmp_path, bytes(content))


@both
def test_decoded_data_beyond_memory_are_refused(tmp_path: Path, compress: Compress) -> None:
    bomb = compress(TEXT + b"9" * (10 * BLOCK_BYTES))
    assert len(bomb) < BLOCK_BYTES / 50
    assert "a line is longer than" in refusal(tmp_path, bomb)


@both
def test_a_file_that_becomes_far_more_than_it_is_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compress: Compress
) -> None:
    bomb = compress(TEXT + b"1,1,1\n" * 100_000)
    monkeypatch.setattr(source, "FREE_ROWS", 50_000)
    assert "it has more than" in refusal(tmp_path, bomb)
    monkeypatch.setattr(source, "FREE_ROWS", 10**6)
    monkeypatch.setattr(source, "FREE_BYTES", 10_000)
    assert "it decompresses to more than" in refusal(tmp_path, bomb)


def test_a_full_disk_is_an_error_that_names_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    spool = Spool()
    spool._file.close()
    spool._file = _Full()  # type: ignore[assignment]
    with pytest.raises(InputError, match=r"no room for a temporary copy .*TMPDIR") as caught:
        spool.add(1, b"much")
    assert str(caught.value).startswith(str(tmp_path))


class _Full:
    """A file on a disk that is full."""

    def seek(self, place: int) -> int:
        return place

    def write(self, _: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
