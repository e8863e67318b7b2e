"""Angles of a program by the kernel of the warehouse, which does not use programs."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.columns.drive_columns import DriveCounts, compute_columns
from fleet_slip.export.program import Program
from fleet_slip.export.stepping import Sample, valid_counts
from fleet_slip.grams.compute import counts_of
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import Predictor
from tests.export.cars import Car


def angles_by_kernel(
    signals: SignalCatalog,
    manifest: Manifest,
    program: Program,
    car: Car,
    samples: Sequence[Sample],
) -> list[int | None]:
    """Compute the angle of each tick from the columns of the kernel, in exact integers."""
    predictor = Predictor.from_manifest(signals, manifest)
    drive = drive_counts(program, predictor, car, samples)
    return angles_of_columns(program, compute_columns(predictor.plan, drive))


def drive_counts(
    program: Program, predictor: Predictor, car: Car, samples: Sequence[Sample]
) -> DriveCounts:
    """Convert samples of consecutive ticks to a drive of the warehouse."""
    valid = zip(*(valid_counts(sample, program.signals) for sample in samples), strict=True)
    counts = {
        signal.name: pa.array(values, pa.int16())
        for signal, values in zip(program.signals, valid, strict=True)
    }
    rows = pa.table({"tick": np.arange(len(samples), dtype=np.int64), **counts})
    facts = {name: car.facts.get(name) for name in predictor.plan.facts}
    return counts_of(rows, predictor.plan, facts, car.numbers)


def angles_of_columns(program: Program, columns: FloatArray) -> list[int | None]:
    """Compute the angle of each row from the columns of the terms, shape (terms, rows)."""
    angle = program.angle
    missing: BoolArray = np.any(np.isnan(columns), axis=0)
    counts = np.where(missing, 0.0, columns).astype(np.int64).astype(object)
    total = np.full(columns.shape[1], angle.intercept + (1 << (angle.bits - 1)), dtype=object)
    for (_, coefficient), column in zip(angle.terms, counts, strict=True):
        total += coefficient * column
    rounded = [max(-angle.limit, min(angle.limit, int(value >> angle.bits))) for value in total]
    return [None if lacks else value for value, lacks in zip(rounded, missing, strict=True)]
