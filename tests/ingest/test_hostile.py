"""Files from strangers: whatever the bytes, the outcome is a log or one of our own errors."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import FleetSlipError
from tests.support.logs import schema_without
from tests.support.measured import MeasuredLog, a_mapping, csv_text, good_columns, read_measured

CASES = settings(
    max_examples=100,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
MAPPINGS = (
    a_mapping(),
    a_mapping(csv={"separator": ";", "decimal_comma": True}, missing=["NaN", "-"]),
    a_mapping(time={"rate_hz": 250}, drive={"column": "t", "vehicle_id": {"column": "ax"}}),
    a_mapping(
        time={"unit": None, "format": "%Y-%m-%dT%H:%M:%S%.f"},
        drive={"day": {"column": "t"}, "mass_kg": {"column": "beta"}},
    ),
)


def outcome(folder: Path, data: bytes) -> None:
    """Read the bytes through each mapping; what comes out must be consistent."""
    file = folder / "hostile"
    file.write_bytes(data)
    for mapping in MAPPINGS:
        try:
            check(read_measured(file, mapping))
        except FleetSlipError as error:
            assert "\n" not in str(error)
            assert len(str(error)) < 10_000


def check(log: MeasuredLog) -> None:
    log.drives.validate(full=True)
    log.quarantine.validate(full=True)
    assert log.drives.cast(schema_without(catalogue().extras)).num_rows == log.counts.ticks > 0
    assert log.counts.rows_read == log.counts.rows_kept + log.quarantine.num_rows


fields = st.one_of(
    st.sampled_from([*"01-\t\"';,\r\n", "", "nan", "inf", "1e308", "-0.0", "1,5", "0.01", "0.02"]),
    st.sampled_from(["2024-05-31T00:00:00.01", "9999-12-31T23:59:59", "0000-00-00"]),
    st.just("'; DROP TABLE logs; --"),
    st.floats().map(str),
    st.integers().map(str),
    st.text(max_size=8),
)
headers = st.lists(st.sampled_from(["t", "ax", "beta", "x", '"', "", "^.*$"]), max_size=6)


@CASES
@given(headers, st.lists(st.lists(fields, max_size=5), max_size=12), st.sampled_from(",;\t"))
def test_any_csv(tmp_path: Path, header: list[str], rows: list[list[str]], separator: str) -> None:
    names = ["t", "ax", "beta", *header]
    lines = [separator.join(row) for row in [names, *rows]]
    outcome(tmp_path, "\n".join(lines).encode("utf-8", "surrogatepass"))


@CASES
@given(st.binary(max_size=300), st.sampled_from([b"", b"t,ax,beta\n", b"t,ax,beta\n0,1,2\n"]))
def test_any_bytes(tmp_path: Path, data: bytes, head: bytes) -> None:
    outcome(tmp_path, head + data)


def as_parquet(columns: dict[str, Any], **options: Any) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(pa.table(columns), buffer, **options)
    return buffer.getvalue()


SEEDS = [
    as_parquet(
        {
            "t": np.arange(50) / 100,
            "ax": pa.array([None if i % 7 == 0 else i / 10 for i in range(50)]),
            "beta": pa.array([str(i) for i in range(50)]).dictionary_encode(),
        },
        compression=compression,
        row_group_size=20,
    )
    for compression in ("none", "snappy", "zstd", "gzip")
] + [csv_text(good_columns(12)).encode()]


@CASES
@given(
    st.sampled_from(SEEDS),
    st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=4),
    st.integers(0, 10**6),
)
def test_damaged_files(
    tmp_path: Path, seed: bytes, damage: list[tuple[int, int]], length: int
) -> None:
    data = bytearray(seed)
    for position, byte in damage:
        data[position % len(data)] = byte
    outcome(tmp_path, bytes(data[: length % (2 * len(data)) or None]))


@pytest.mark.parametrize("rows", [400_000])
def test_a_small_file_with_many_rows_stays_small(tmp_path: Path, rows: int) -> None:
    same = pa.array(np.zeros(rows))
    outcome(tmp_path, as_parquet({"t": same, "ax": same, "beta": same}, compression="zstd"))
