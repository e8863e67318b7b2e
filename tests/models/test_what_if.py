"""What worse sensors would do, against rows with the bias and the noise in them."""

from fractions import Fraction

import numpy as np
import pytest

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import QuestionError
from fleet_slip.models.diagnose import what_if
from fleet_slip.regression.least_squares import LinearModel, fit
from tests.support.cohorts import INPUTS, LABEL, Driven, cohort_of, driven, rows_of

COEFFICIENTS = (0.1, 0.4, 0.9, 0.2)
UNIT = float(catalogue()[LABEL].scale)


def fitted(drives: list[Driven]) -> LinearModel:
    return fit(cohort_of(drives).serving(INPUTS).table.total(), INPUTS, LABEL).model


def si(counts: float, name: str) -> float:
    """Return counts of a signal in its unit."""
    return counts * float(input_scales()[name])


@pytest.fixture(scope="module")
def drives() -> list[Driven]:
    return driven(1, COEFFICIENTS, drives=20, rows=500)


def test_nothing_added_changes_nothing(drives: list[Driven]) -> None:
    model = fitted(drives)
    found = what_if(cohort_of(drives), model, bias={}, noise={})
    assert found.before == found.after == found.refitted_after
    assert found.drives == 20
    scales = input_scales()
    assert found.refitted.weights == pytest.approx(model.physical(scales).weights)


def test_a_bias_moves_the_mean_by_its_coefficient_and_no_more(drives: list[Driven]) -> None:
    found = what_if(cohort_of(drives), fitted(drives), bias={"ay": si(250, "ay")}, noise={})
    shift = 250 * fitted(drives).weights["ay"] * UNIT
    assert found.after.error_mean == pytest.approx(found.before.error_mean + shift, rel=1e-9)
    assert found.after.error_std == pytest.approx(found.before.error_std, rel=1e-9)


def test_noise_widens_the_error_as_rows_with_noise_do(drives: list[Driven]) -> None:
    noise = {"yaw_rate": 150, "ay": 100}
    model = fitted(drives)
    found = what_if(
        cohort_of(drives), model, bias={}, noise={k: si(v, k) for k, v in noise.items()}
    )
    rows = rows_of(drives).astype(float)
    rng = np.random.default_rng(0)
    for name, size in noise.items():
        rows[:, INPUTS.index(name)] += rng.normal(0, size, len(rows))
    weights = np.array([model.weights[name] for name in INPUTS])
    error = model.offset + rows[:, :-1] @ weights - rows[:, -1]
    assert found.after.rmse == pytest.approx(UNIT * np.sqrt(np.mean(error**2)), rel=0.02)
    x = np.column_stack([np.ones(len(rows)), rows[:, :-1]])
    refitted = np.linalg.lstsq(x, rows[:, -1], rcond=None)[0]
    scales = input_scales()
    for name, weight in zip(INPUTS, refitted[1:], strict=True):
        unit = float(scales[LABEL] / scales[name])
        assert found.refitted.weights[name] == pytest.approx(weight * unit, abs=0.01 * unit)
    assert found.before.rmse < found.refitted_after.rmse < found.after.rmse
    assert found.as_dict()["refitted"]["yaw_rate"] == found.refitted.weights["yaw_rate"]


def test_a_signal_inside_a_feature_has_no_closed_form() -> None:
    known = features().features["curvature"]
    model = LinearModel(("curvature",), LABEL, (Fraction(1),), Fraction(0))
    for name in known.inputs:
        with pytest.raises(QuestionError, match=f"{name} also enters the model through curvature"):
            what_if(cohort_of(driven(1, COEFFICIENTS)), model, bias={name: 1.0}, noise={})


def test_a_signal_that_the_model_does_not_use_is_refused(drives: list[Driven]) -> None:
    with pytest.raises(QuestionError, match="wheel_fl"):
        what_if(cohort_of(drives), fitted(drives), bias={}, noise={"wheel_fl": 1.0})
