"""The streaming object has the bits of `predict` and `score`, sample by sample."""

from fractions import Fraction

import pytest

from fleet_slip.errors import InputError
from fleet_slip.export.stepping import Estimator
from tests.export.models import model_of


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
