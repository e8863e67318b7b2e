"""Estimates of models that look back: drives that lie together, that are mixed, and blocks."""

from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa

from fleet_slip.columns.drive_columns import BLOCK_ROWS, DriveCounts, compute_columns
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from tests.export.models import MODELS, model_of
from tests.support.catalog import CATALOG, SIGNALS

MANIFEST = model_of(MODELS["every_kind"], Fraction(1, 7))
NUMBERS = {"yaw_rate_offset": -30, "speed_ratio": 2003, "understeer": 55}


def drive_of(rows: int, seed: int) -> DriveCounts:
    """Counts of ordinary sizes, some of them missing, with holes between ticks."""
    random = np.random.default_rng(seed)
    signals = Predictor.from_manifest(SIGNALS, MANIFEST).plan.signals
    counts = {name: random.integers(900, 1800, rows).astype(np.int16) for name in signals}
    present = {name: random.random(rows) < 0.999 for name in signals}
    facts = {"mass_kg": 1320.5 + seed, "vehicle_model": "suv" if seed % 2 else "van"}
    ticks = np.cumsum(random.random(rows) < 0.001) + np.arange(rows)
    return DriveCounts(ticks, counts, present, facts, NUMBERS if seed % 2 else {})


def test_blocks_of_rows_have_the_bits_of_the_whole_drive() -> None:
    """One predictor for drives of several lengths, against a dot product over all columns."""
    predictor = Predictor.from_manifest(SIGNALS, MANIFEST)
    for rows, seed in ((3 * BLOCK_ROWS + 7, 1), (BLOCK_ROWS, 2), (1, 3), (BLOCK_ROWS + 1, 4)):
        drive = drive_of(rows, seed)
        expected = np.full(rows, predictor.intercept)
        columns = compute_columns(predictor.plan, drive)
        for column, coefficient, scale in zip(
            columns, predictor.coefficients, predictor.scales, strict=True
        ):
            expected += coefficient * (column * scale)
        angles = predictor(drive)
        assert np.array_equal(angles, expected, equal_nan=True)
        assert np.isfinite(angles).any() or rows == 1


def frame_of(drive: DriveCounts, name: str) -> pl.DataFrame:
    """A drive in SI units."""
    columns = {
        SIGNALS[column].column: pl.Series(
            np.where(drive.present[column], counts * float(SIGNALS[column].scale), np.nan)
        )
        for column, counts in drive.counts.items()
    }
    counts_by_name = {name: drive.numbers.get(name) for name in NUMBERS}
    grains = {"yaw_rate_offset": 0.00000625, "speed_ratio": 0.0005, "understeer": 0.00002}
    numbers = {
        column: None if n is None else n * grains[column] for column, n in counts_by_name.items()
    }
    return pl.DataFrame({"drive_id": name, "tick": drive.ticks, **columns}).with_columns(
        pl.lit(drive.facts["mass_kg"]).alias("mass_kg"),
        pl.lit(drive.facts["vehicle_model"]).alias("vehicle_model"),
        *(pl.lit(value, pl.Float64).alias(column) for column, value in numbers.items()),
    )


def test_drives_that_are_mixed_have_the_angles_of_each_alone() -> None:
    version = ModelVersion(1, MANIFEST, "0" * 64, CATALOG)
    drives = {f"drive {seed}": drive_of(rows, seed) for rows, seed in ((1300, 1), (40, 2), (9, 5))}
    predictor = Predictor.from_manifest(SIGNALS, MANIFEST)
    expected = np.concatenate([predictor(drive) for drive in drives.values()])
    together = pl.concat([frame_of(drive, name) for name, drive in drives.items()])
    predicted = version.predict(together).to_numpy()
    assert np.array_equal(predicted, expected, equal_nan=True)
    assert np.isfinite(predicted).sum() > 1000
    mixed = together.with_row_index("place").sort("tick", "drive_id")
    angles = version.predict(mixed).to_numpy()[np.argsort(mixed["place"].to_numpy())]
    assert np.array_equal(angles, expected, equal_nan=True)
    parts = [frame_of(drive, name).to_pandas() for name, drive in drives.items()]
    joined = pd.concat([part.astype({"drive_id": "str"}) for part in parts], ignore_index=True)
    angles = version.predict(joined).to_numpy()  # its texts have several chunks
    assert np.array_equal(angles, expected, equal_nan=True)


def test_threads_that_share_a_version_do_not_share_memory() -> None:
    version = ModelVersion(1, MANIFEST, "0" * 64, CATALOG)
    frames = [frame_of(drive_of(2000, seed), "drive") for seed in range(4)]
    expected = [
        ModelVersion(1, MANIFEST, "0" * 64, CATALOG).predict(frame).to_list() for frame in frames
    ]
    with ThreadPoolExecutor(4) as pool:
        angles = [*pool.map(lambda frame: version.predict(frame).to_list(), frames * 8)]
    assert angles == expected * 8


def test_a_frame_without_rows_has_no_angles() -> None:
    version = ModelVersion(1, MANIFEST, "0" * 64, CATALOG)
    empty = frame_of(drive_of(3, 1), "drive").head(0)
    assert version.predict(empty).to_list() == []
    assert version.predict(empty.to_arrow()).to_pylist() == []
    assert isinstance(version.predict(empty.to_arrow()), pa.ChunkedArray)
