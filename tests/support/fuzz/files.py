"""Measured files as strangers send them: CSV and Parquet, mostly plausible, then damaged."""

import io
import random
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_slip.ingest.mapping import Mapping
from tests.support.catalog import SIGNALS
from tests.support.fuzz.mutate import NUMBERS, WORDS, mutate_bytes

COLUMNS = ("t", "ax", "beta", "car", "day")
_BASE: dict[str, Any] = {
    "name": "fuzz",
    "time": {"column": "t", "unit": "s"},
    "drive": {"day": "2024-05-31", "vehicle_id": "car", "vehicle_model": "sedan"},
    "signals": {
        "ax": {"column": "ax", "unit": "m/s^2"},
        "sideslip": {"column": "beta", "unit": "deg"},
    },
}
_CHANGES: tuple[dict[str, Any], ...] = (
    {},
    {"csv": {"separator": ";", "decimal_comma": True}, "missing": ["NaN", "-"]},
    {"time": {"rate_hz": 250}, "drive": {**_BASE["drive"], "column": "car"}},
    {"drive": {**_BASE["drive"], "vehicle_id": {"column": "car"}}},
    {"time": {"column": "day", "format": "%Y-%m-%dT%H:%M:%S%.f"}},
    {"drive": {**_BASE["drive"], "mass_kg": {"column": "beta"}, "track": {"column": "car"}}},
    {"drive": {**_BASE["drive"], "day": {"column": "day"}}},
)
MAPPINGS = tuple(
    Mapping.model_validate({**_BASE, **change}, context=SIGNALS) for change in _CHANGES
)
"""The first is the one that fits the files best."""


def csv_file(rng: random.Random) -> bytes:
    """Return a CSV file."""
    separator = rng.choice([*[","] * 12, ";", "\t"])
    columns = _names(rng)
    rows = rng.choice([0, 1, 5, 30, 30, 200, 200])
    if len(columns) > 100:  # to write many cells takes longer than to refuse them
        rows = min(rows, 1)
    lines = [separator.join(columns)]
    for tick in range(rows):
        cells = [_cell(rng, name, tick) for name in columns]
        if rng.random() < 0.03:
            cells = cells[: rng.randrange(len(cells) + 1)] + [rng.choice(WORDS)] * rng.randrange(4)
        lines.append(separator.join(cells))
    text = rng.choice(["\n", "\n", "\r\n"]).join(lines) + rng.choice(["\n", ""])
    encoding = rng.choice(["utf-8"] * 20 + ["utf-8-sig", "utf-16", "latin-1", "utf-7"])
    data = text.encode(encoding, "replace" if encoding == "latin-1" else "surrogatepass")
    return mutate_bytes(rng, data, edges=40) if rng.random() < 0.3 else data


def _names(rng: random.Random) -> list[str]:
    names = list(COLUMNS)
    if rng.random() < 0.3:
        rng.shuffle(names)
    if rng.random() < 0.2:
        names.insert(rng.randrange(len(names)), rng.choice([*WORDS, *names]))
    if rng.random() < 0.05:
        del names[rng.randrange(len(names))]
    if rng.random() < 0.02:
        names += [f"c{i}" for i in range(rng.choice([500, 20_000]))]
    return names


def _cell(rng: random.Random, name: str, tick: int) -> str:
    if rng.random() < 0.02:
        return rng.choice([*WORDS, *map(str, NUMBERS[:9]), *map(str, NUMBERS[10:])])
    match name:
        case "t":
            jump = rng.choice([0.0] * 30 + [-0.05, 5.0, 0.004, -3.0])
            return f"{tick / 100 + jump:.3f}"
        case "car":
            return "car-1"
        case "day":
            return f"2024-05-31T00:00:{tick % 60:02d}.00"
        case _:
            return f"{0.1 * tick - 1:.2f}"


def parquet_file(rng: random.Random) -> bytes:
    """Return a Parquet file."""
    if rng.random() < 0.01:
        return _bomb(rng)
    rows = rng.choice([0, 1, 30, 300])
    names = _names(rng)
    if len(names) > 100:  # to write many columns takes more memory than to refuse them
        rows = 1
    arrays = [_array(rng, name, rows) for name in names]
    buffer = io.BytesIO()
    pq.write_table(
        pa.Table.from_arrays(arrays, names=names),
        buffer,
        compression=rng.choice(["none", "snappy", "zstd", "gzip", "brotli", "lz4"]),
        use_dictionary=rng.random() < 0.5,
        data_page_version=rng.choice(["1.0", "2.0"]),
        row_group_size=rng.choice([7, 100, 10_000]),
        write_page_checksum=rng.random() < 0.2,
        store_schema=rng.random() < 0.7,
    )
    data = buffer.getvalue()
    return mutate_bytes(rng, data, edges=400) if rng.random() < 0.6 else data


def _bomb(rng: random.Random) -> bytes:
    """Many rows or long texts in few bytes."""
    rows = rng.choice([1_000_000, 3_000_000])
    zeros = pa.array(np.zeros(rows))
    text = pa.array(["x" * rng.choice([900, 2_000_000])]).dictionary_encode()
    texts = text.take(pa.array(np.zeros(rows // 100, dtype=np.int32)))
    names, arrays = ["t", "ax", "beta"], [zeros, zeros, zeros]
    if rng.random() < 0.5:
        names, arrays = [*names, "car"], [zeros[: len(texts)]] * 3 + [texts]
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(arrays, names=names), buffer, compression="zstd")
    return buffer.getvalue()


def _array(rng: random.Random, name: str, rows: int) -> pa.Array:
    if rng.random() < 0.05:
        return _odd_array(rng, rows)
    tick = np.arange(rows)
    match name:
        case "t":
            values: Any = tick / 100
        case "car":
            return pa.array(["car-1"] * rows)
        case "day":
            return pa.array((tick * 10_000).tolist(), pa.timestamp("us"))
        case _:
            values = 0.1 * tick - 1
    if rows and rng.random() < 0.3:
        values[rng.randrange(rows)] = float(rng.choice(NUMBERS[10:]))
    return pa.array(values)


def _odd_array(rng: random.Random, rows: int) -> pa.Array:
    """A column of a type or with values that a reader may not expect."""
    ones = pa.array([1] * rows, pa.int64())
    makers = (
        lambda: ones.cast(pa.int8()),
        lambda: ones.cast(pa.float32()),
        lambda: pa.array(np.ones(rows, dtype=np.float16)),
        lambda: pa.array([2**64 - 1] * rows, pa.uint64()),
        lambda: ones.cast(pa.decimal128(38, 10)),
        lambda: ones.cast(pa.bool_()),
        lambda: pa.array([b"\xff\0"] * rows, pa.binary()),
        lambda: pa.array([rng.choice(WORDS)] * rows).dictionary_encode(),
        lambda: pa.array([rng.choice(WORDS)] * rows, pa.large_string()),
        lambda: pa.array([[1.0]] * rows, pa.list_(pa.float64())),
        lambda: pa.array([{"a": 1}] * rows, pa.struct([("a", pa.int64())])),
        lambda: pa.nulls(rows),
        lambda: pa.array([2**52] * rows, pa.timestamp("s", tz="UTC")),
        lambda: pa.array([-(2**31)] * rows, pa.date32()),
        lambda: pa.array([1] * rows, pa.duration("ns")),
        lambda: pa.array([1] * rows, pa.time64("us")),
    )
    return rng.choice(makers)()
