"""CSV files that were compressed, by the standard library's gzip and by Arrow's zstd."""

import gzip
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from fleet_slip.ingest.formats import source
from fleet_slip.ingest.formats.csv import BLOCK_BYTES
from tests.support.logs import without_names
from tests.support.measured import a_mapping, csv_text, failure, good_columns, read_text

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
    whole = compress(TEXT)
    for kept in (len(whole) // 2, len(whole) - 1):
        assert "Truncated compressed stream" in refusal(tmp_path, whole[:kept])


def test_a_flipped_bit_is_noticed_by_the_checksum_of_gzip(tmp_path: Path) -> None:
    content = bytearray(gzip.compress(TEXT))
    content[-6] ^= 1  # in the CRC-32
    assert "cannot be read" in refusal(tmp_path, bytes(content))


@both
def test_what_would_not_fit_into_memory_is_refused_while_it_unfolds(
    tmp_path: Path, compress: Compress
) -> None:
    bomb = compress(TEXT + b"9" * (10 * BLOCK_BYTES))
    assert len(bomb) < BLOCK_BYTES / 50
    assert "a line is longer than" in refusal(tmp_path, bomb)


@both
def test_a_file_that_becomes_far_more_than_it_is_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compress: Compress
) -> None:
    bomb = compress(TEXT + b"1,1,1\n" * 100_000)
    monkeypatch.setattr(source, "FREE_ROWS", 50_000)
    assert "rows or more in" in refusal(tmp_path, bomb)
    monkeypatch.setattr(source, "FREE_ROWS", 10**6)
    monkeypatch.setattr(source, "FREE_BYTES", 10_000)
    assert "bytes decompress to" in refusal(tmp_path, bomb)
