"""What stands in a data file before its rows: found by its first bytes, never damaged unseen."""

from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet
import pytest

from fleet_slip.delta import Encoding
from fleet_slip.delta.encoding import FIRST_BYTES, pack_leading_parts, read_leading_part
from fleet_slip.errors import StorageError
from fleet_slip.files.local_folder import LocalFolder

PARTS = [b"first", b"", bytes(range(256)) * (FIRST_BYTES // 128), b"last"]
ROWS = pa.table({"a": list(range(1000)), "b": [[i, -i] for i in range(1000)]})


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "rows.parquet"
    path.write_bytes(Encoding(compression="zstd").encode(ROWS, leading=PARTS).content)
    return path


def part_of(file: Path, number: int) -> bytes | None:
    return read_leading_part(LocalFolder(file.parent), file.name, number)


def test_every_part_is_found_and_every_reader_finds_the_rows(file: Path) -> None:
    assert [part_of(file, number) for number in range(5)] == [*PARTS, None]
    assert pa.parquet.read_table(file).to_pylist() == ROWS.to_pylist()
    with duckdb.connect() as database:
        found = database.sql(f"SELECT count(*), sum(a), sum(b[2]) FROM '{file}'").fetchall()
    assert found == [(1000, 499_500, -499_500)]


def test_a_file_without_has_the_bytes_that_it_always_had(tmp_path: Path) -> None:
    content = Encoding().encode(ROWS).content
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(
        ROWS.cast(pa.schema([field.with_nullable(False) for field in ROWS.schema])),
        sink,
        write_batch_size=2**14,
        row_group_size=2**17,
        use_dictionary=[],
        compression="none",
    )
    assert content.equals(sink.getvalue())
    (tmp_path / "plain.parquet").write_bytes(content)
    assert part_of(tmp_path / "plain.parquet", 0) is None


@pytest.mark.parametrize("name", ["", "PAR1", "PAR1FSPF"])
def test_a_file_that_ends_early_has_none(tmp_path: Path, name: str) -> None:
    (tmp_path / "short.parquet").write_bytes(name.encode())
    assert part_of(tmp_path / "short.parquet", 0) is None


def test_a_part_that_is_cut_off_is_damage(file: Path) -> None:
    for size in (20, 40, len(pack_leading_parts(PARTS))):
        file.write_bytes(file.read_bytes()[:size])
        with pytest.raises(StorageError, match="does not match its checksum"):
            part_of(file, 3)


def test_no_flipped_bit_passes_unseen(file: Path) -> None:
    """Either the part is the same, or there seems to be none, or the file is called damaged."""
    sound, places = file.read_bytes(), len(pack_leading_parts(PARTS)) + 4
    unnoticed = []
    for at in [*range(100), *range(100, places, 9973), places - 1]:
        for bit in (0, 5):
            flipped = bytearray(sound)
            flipped[at] ^= 1 << bit
            file.write_bytes(flipped)
            for number, part in enumerate(PARTS):
                try:
                    found = part_of(file, number)
                except StorageError:
                    continue
                if found not in (part, None) or (found is None and at >= 12):
                    unnoticed.append((at, number))
    assert not unnoticed
