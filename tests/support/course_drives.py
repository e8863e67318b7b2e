"""A drive whose course has gaps, errors and turns."""

from typing import Any

import numpy as np
import pyarrow as pa

from tests.support.catalog import SIGNALS
from tests.support.logs import log_rows, random_counts

LABEL = SIGNALS.label


def hostile_drive(name: str, rows: int, seed: int, *, fix_ticks: int = 10) -> pa.Table:
    """A drive with fixes that fail, missing values, holes in time, and a course that goes round."""
    rng = np.random.default_rng(seed)
    counts: dict[str, Any] = random_counts(rng, rows)
    for wheel in ("fl", "fr", "rl", "rr"):
        counts[f"wheel_{wheel}"] = rng.integers(0, 12_000, rows).astype(np.int16)
    counts["yaw_rate"] = rng.integers(-9000, 9000, rows).astype(np.int16)
    counts["yaw_rate"][rows // 2 :] //= 64
    lost = (np.arange(rows) % fix_ticks != 0) | (rng.random(rows) < 0.1)
    counts["course"] = pa.array(counts["course"], mask=lost)
    counts["ay"] = pa.array(counts["ay"], mask=rng.random(rows) < 0.05)
    counts["yaw_rate"] = pa.array(counts["yaw_rate"], mask=rng.random(rows) < 0.3 / rows)
    counts[LABEL] = pa.nulls(rows, pa.int16())
    counts["tick"] = np.arange(rows) + np.where(np.arange(rows) > rows * 2 // 3, 300, 0)
    return log_rows(name, counts)
