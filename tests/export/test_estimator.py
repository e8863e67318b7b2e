"""The streaming object has the bits of `predict` and `score`, sample by sample."""

from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fleet_slip
from fleet_slip.errors import InputError
from fleet_slip.export.compile import Sample, compile_program, drive_counts
from fleet_slip.export.program import Car, Program
from fleet_slip.export.stepping import Estimator
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.predict import Predictor
from tests.export.models import cars, drives, model_of, models


def in_si(program: Program, sample: Sample) -> dict[str, float | None]:
    return {
        one.column: None if count is None else count * float(one.scale)
        for one, count in zip(program.signals, sample, strict=True)
    }


def known(program: Program, car: Car) -> dict[str, object]:
    """What `Fleet.estimator` is told of a car: numbers in SI units."""
    facts = {one.name: car.facts[one.name] for one in program.facts}
    numbers = {
        one.name: Decimal(car.numbers[one.name]) * one.grain
        for one in program.numbers
        if one.name in car.numbers
    }
    return {**facts, **numbers}


@settings(max_examples=40)
@given(models(), cars(), st.data())
def test_any_model_on_any_drive_has_the_bits_of_the_kernel(
    manifest: Manifest, car: Car, data: st.DataObject
) -> None:
    program = compile_program(manifest)
    samples = data.draw(drives(program))  # counts beyond their ranges among them
    predictor = Predictor.of(manifest)
    expected = predictor(drive_counts(program, predictor, car, samples))
    estimator = Estimator(manifest, known(program, car))
    found = [estimator.step(in_si(program, sample)) for sample in samples]
    assert [np.nan if one is None else one for one in found] == pytest.approx(
        expected.tolist(), rel=0, abs=0, nan_ok=True
    )


def test_a_whole_drive_has_the_bits_of_predict(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    estimator = fleet.estimator("smoke")
    drive = fleet.sql(
        "SELECT * FROM log WHERE drive_id = 'smoke-2024-05-01-0003' ORDER BY tick"
    ).pl()
    predicted = fleet.model("smoke").predict(drive).to_list()
    rows = drive.to_dicts()
    assert [estimator.step(row) for row in rows] == predicted
    estimator.restart()
    assert [estimator.step(row) for row in rows[:50]] == predicted[:50]


@pytest.mark.parametrize("ticks", [1, 3, 4, 5, 10**12])
def test_ticks_that_are_skipped_are_missing(ticks: int) -> None:
    """A mean over 5 ticks: 1 m/s^2 before the hole, 3 m/s^2 after it."""
    estimator = Estimator(model_of({"mean_5": Fraction(1)}))
    for _ in range(5):
        estimator.step({"ay_mps2": 1.0})
    estimator.skip(ticks)
    there = max(5 - 1 - ticks, 0)
    counts = Fraction(1000 * there + 3000, 7 * (there + 1))
    nearest = int(counts + Fraction(1, 2))
    assert estimator.step({"ay_mps2": 3.0}) == nearest * 0.001


def test_what_is_missing_or_unknown_is_said() -> None:
    manifest = model_of({"ay": Fraction(1), "heavy": Fraction(1)})
    with pytest.raises(InputError, match=r"does not use adhesion of a car\. It uses: mass_kg"):
        Estimator(manifest, {"adhesion": 1.0})
    estimator = Estimator(manifest, {"mass_kg": 1500})
    with pytest.raises(InputError, match="needs ay_mps2 in every sample"):
        estimator.step({"ay": 3})
    with pytest.raises(InputError, match="no number"):
        estimator.step({"ay_mps2": "fast"})  # type: ignore[dict-item]
    assert estimator.step({"ay_mps2": None}) is None
    assert estimator.step({"ay_mps2": float("inf")}) is None
    assert estimator.step({"ay_mps2": 1.0}) is not None
    assert Estimator(manifest).step({"ay_mps2": 1.0}) is None
