"""A Gram row of each car of a fleet, all different, quickly."""

from datetime import UTC, datetime

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.on_board import COLUMNS, counted_sets


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
    signals = catalogue().gram_signals
    random = np.random.default_rng(seed)
    k = len(signals)
    n = random.integers(2_000, 360_000, cars)
    low, high = np.array([(catalogue()[s].min_count, catalogue()[s].max_count) for s in signals]).T
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
    known = {
        "source": ["received"] * cars,
        "vehicle_id": names,
        "drive_id": [f"{name}-{start:%Y%m%dT%H%M%SZ}" for name in names],
        "day": [start.date()] * cars,
        "feature_set": [next(iter(counted_sets().values())).key] * cars,
        "part": [None] * cars,
        "course_late": [None] * cars,
        "signals": [",".join(signals)] * cars,
        "n": n,
        "sums": list_array(sums),
        "products": list_array(products),
    }
    return pa.table(known, schema=COLUMNS)
