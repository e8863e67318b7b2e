"""Gram rows that cars counted: tables of them, and the messages of exported C."""

import re
import struct
import zlib
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_slip.arrays import IntArray
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.grams.on_board import COLUMNS, onboard_feature_sets
from fleet_slip.regression.gram import Gram
from tests.support.catalog import CATALOG, SIGNALS

START_S = 1_714_557_600
"""2024-05-01, 10:00 in UTC."""

PAGE = Path(__file__).parents[2] / "docs" / "export.md"


def row_of(
    gram: Gram,
    vehicle: str = "VIN1",
    start_s: int = START_S,
    set_name: str = "signals",
    **other: Any,
) -> dict[str, Any]:
    """A row of the table of a Gram; `other` columns are as they should not be."""
    (key,) = (
        feature_set.key
        for feature_set in onboard_feature_sets(CATALOG).values()
        if feature_set.name == set_name
    )
    start = datetime.fromtimestamp(start_s, UTC)
    row = {"source": "received", "vehicle_id": vehicle, "day": start.date(), "feature_set": key}
    row |= {"drive_id": f"{vehicle}-{start:%Y%m%dT%H%M%SZ}", "part": None, "course_late": None}
    row |= {"signals": ",".join(gram.signals), "n": gram.n}
    return row | {"sums": gram.sums, "products": gram.products} | other


def write_counted(path: Path, rows: Iterable[Mapping[str, Any]] | pa.Table) -> Path:
    """Write a table of Gram rows as a platform does."""
    if not isinstance(rows, pa.Table):
        rows = pa.Table.from_pylist(list(rows), schema=COLUMNS)
    pq.write_table(rows, path, write_page_checksum=True)
    return path


@cache
def _reading() -> dict[str, Any]:
    """Return the names that the Python code of the page defines."""
    namespace: dict[str, Any] = {}
    exec(re.findall(r"```python\n([^`]*def row_of.*?)```", PAGE.read_text(), re.S)[0], namespace)  # noqa: S102
    return namespace


def rows_of_messages(content: bytes, catalog: Catalog = CATALOG) -> list[dict[str, Any]]:
    """The rows that the page makes of messages one behind the other."""
    rows: list[dict[str, Any]] = []
    sets = {
        feature_set.definition: feature_set
        for feature_set in onboard_feature_sets(catalog).values()
    }
    while content:
        size = int.from_bytes(content[6:8], "little")
        rows.append(_reading()["row_of"](content[:size], sets))
        content = content[size:]
    return rows


def drive_counts(seed: int, rows: int = 500) -> Any:
    """Counts of all signals of a drive, shape (rows, signals), related as those of a car are."""
    random = np.random.default_rng(seed)
    k = len(SIGNALS.gram_signals)
    hidden = random.normal(0, 900, (rows, 4))
    counts = hidden @ random.normal(0, 1, (4, k)) + random.normal(0, 30, (rows, k))
    signals = [SIGNALS[name] for name in SIGNALS.gram_signals]
    low, high = ([s.min_count for s in signals], [s.max_count for s in signals])
    return np.clip(np.rint(counts), low, high).astype(np.int16)


def gram_of(seed: int, rows: int = 500) -> Gram:
    """The Gram of a drive of all signals."""
    return Gram.from_counts(SIGNALS.gram_signals, drive_counts(seed, rows).astype(np.int64))


class Message(NamedTuple):
    """The content of a message, decoded by the layout of docs/export.md."""

    definition: int
    vehicle: bytes
    place: int
    parts: int
    start_s: int
    mask: int
    rows: int
    lost: int
    numbers: bytes
    content: bytes


def parse_messages(content: bytes) -> list[Message]:
    """Read sound messages one behind the other, one at a time; the first that is not ends it."""
    messages = []
    at = 0
    while content[at : at + 6] == b"FSGR\x01\0":
        size = int.from_bytes(content[at + 6 : at + 8], "little")
        body = content[at : at + size]
        if len(body) < size or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            break
        definition, vehicle, place, parts, start_s, mask, rows, lost = struct.unpack_from(
            "<Q16sHHQIII", body, 8
        )
        name = vehicle.rstrip(b"\0")
        numbers = body[56:-4]
        messages.append(
            Message(definition, name, place, parts, start_s, mask, rows, lost, numbers, body)
        )
        at += size
    return messages


def list_array(values: IntArray) -> pa.ListArray:
    """Return a list for each row of a matrix."""
    rows, width = values.shape
    flat = pa.array(np.ascontiguousarray(values).reshape(-1), pa.int64())
    offsets = pa.array(np.arange(rows + 1, dtype=np.int32) * width, pa.int32())
    return pa.ListArray.from_arrays(offsets, flat)


def rows_of_fleet(cars: int, start_s: int, seed: int, *, label_follows: bool = False) -> pa.Table:
    """Return a Gram row of each of some cars, whose drives began at one moment.

    If the label follows, it is a sum of the inputs, the same in all cars, and noise.
    """
    signals = SIGNALS.gram_signals
    random = np.random.default_rng(seed)
    k = len(signals)
    n = random.integers(2_000, 360_000, cars)
    low, high = np.array([(SIGNALS[s].min_count, SIGNALS[s].max_count) for s in signals]).T
    half = (high - low) / 2
    mean = (low + high) / 2 + random.uniform(-0.2, 0.2, (cars, k)) * half
    spread = random.normal(0, 0.1, (cars, 4, k)) * half
    if label_follows:
        weight = 0.5 / (k - 1) * half[-1] / half[:-1]
        mean[:, -1] = (mean[:, :-1] - (low + high)[:-1] / 2) @ weight
        spread[:, :, -1] = spread[:, :, :-1] @ weight
    square = np.einsum("mik,mil->mkl", spread, spread) + mean[:, :, None] * mean[:, None, :]
    square[:, range(k), range(k)] += (0.01 * half) ** 2
    row, column = np.tril_indices(k)
    sums = np.rint(mean * n[:, None]).astype(np.int64)
    products = np.rint(square[:, row, column] * n[:, None]).astype(np.int64)
    products[:, row == column] += (products[:, row == column] ^ sums) & 1
    start = datetime.fromtimestamp(start_s, UTC)
    names = [f"CAR{car}" for car in range(cars)]
    facts = {
        "source": ["received"] * cars,
        "vehicle_id": names,
        "drive_id": [f"{name}-{start:%Y%m%dT%H%M%SZ}" for name in names],
        "day": [start.date()] * cars,
        "feature_set": [next(iter(onboard_feature_sets(CATALOG).values())).key] * cars,
        "part": [None] * cars,
        "course_late": [None] * cars,
        "signals": [",".join(signals)] * cars,
        "n": n,
        "sums": list_array(sums),
        "products": list_array(products),
    }
    return pa.table(facts, schema=COLUMNS)
