"""Rows as the bytes of a Parquet file: what is declared of them is true."""

import json
from datetime import date

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_slip.storage.checksums import CHECKSUM_DIGITS, checksum_of
from fleet_slip.storage.encoding import ROW_GROUP_ROWS, Encoding


@pytest.mark.parametrize("nulls", [0, 1, 2, 5])
def test_a_column_is_declared_to_have_no_null_if_it_has_none(nulls: int) -> None:
    counts = [None if i < nulls else i for i in range(5)]
    rows = pa.table({"ax": pa.array(counts, pa.int16()), "tick": pa.array(range(5), pa.int32())})
    encoded = Encoding().encode(rows)
    read = pq.read_table(pa.BufferReader(encoded.content))
    assert read.to_pydict() == rows.to_pydict()
    assert read.schema.field("ax").nullable is (nulls > 0)
    assert not read.schema.field("tick").nullable
    statistics = json.loads(encoded.statistics)
    assert statistics == {"numRecords": 5, "nullCount": {"ax": nulls, "tick": 0}}


def test_the_column_of_the_partition_is_left_to_the_folder_and_counted_all_the_same() -> None:
    rows = pa.table({"day": [date(2024, 5, 1)] * 3, "n": [1, 2, 3]})
    encoded = Encoding().encode(rows, omitted=["day", "not there"])
    assert pq.read_schema(pa.BufferReader(encoded.content)).names == ["n"]
    assert set(json.loads(encoded.statistics)["nullCount"]) == {"day", "n"}


def test_the_encodings_are_those_asked_for_in_groups_of_a_fixed_size() -> None:
    count = ROW_GROUP_ROWS + 1
    columns = {"car": ["a"] * count, "ax": pa.array(range(count), pa.int32())}
    encoding = Encoding(dictionary=("car",), delta_packed=("ax",), compression="zstd")
    encoded = encoding.encode(pa.table(columns))
    found = pq.read_metadata(pa.BufferReader(encoded.content))
    assert [found.row_group(i).num_rows for i in range(found.num_row_groups)] == [count - 1, 1]
    car, ax = (found.row_group(0).column(i) for i in range(2))
    assert "RLE_DICTIONARY" in car.encodings
    assert "DELTA_BINARY_PACKED" in ax.encodings
    assert car.compression == "ZSTD"
    assert encoded.checksum == checksum_of(encoded.content)
    assert len(encoded.checksum) == CHECKSUM_DIGITS
    assert encoding.encode(pa.table(columns)).checksum == encoded.checksum
