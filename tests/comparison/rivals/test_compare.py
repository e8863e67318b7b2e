"""Learned rivals: what they learn, what they weigh, and that folds are made of whole drives."""

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.comparison.rivals.compare import (
    TWO_SIGNALS,
    all_signals,
    cross_validate_learner,
    train,
)
from fleet_slip.comparison.rivals.inputs import Inputs, RowSample
from fleet_slip.comparison.rivals.learner import FittedLearner, Learner, Names, hold_back
from fleet_slip.comparison.rivals.learners import (
    CENTRES,
    LAYERS,
    LEARNERS,
    fit_general_regression,
    fit_perceptron,
    fit_regression,
    fit_trees,
    kernel_mean,
)
from fleet_slip.regression.validation.folds import by_hash


def sample(rows: int = 1200, drives: int = 12) -> RowSample:
    generator = np.random.default_rng(3)
    inputs = generator.standard_normal((rows, len(all_signals())))
    label = 0.02 * np.tanh(inputs[:, 1]) - 0.01 * inputs[:, 2]
    names = np.array([f"drive-{i % drives}" for i in range(rows)])
    return RowSample(all_signals(), inputs, label, names)


def two_drives(rows: int) -> Names:
    return np.array([f"drive-{i % 2}" for i in range(rows)])


def test_the_two_sets_of_signals_are_those_of_the_papers() -> None:
    assert TWO_SIGNALS == ("ay", "yaw_rate")
    assert len(all_signals()) == 8
    assert "steer_fl" not in all_signals()


@pytest.mark.parametrize(("drives", "held"), [(2, 1), (8, 1), (20, 2), (100, 12)])
def test_whole_drives_are_held_back(drives: int, held: int) -> None:
    names = np.repeat([f"{number:03}" for number in range(drives)], 7)
    mask = hold_back(names)
    assert mask.sum() == 7 * held
    assert set(names[mask]).isdisjoint(names[~mask])


def test_of_one_drive_the_end_is_held_back() -> None:
    assert np.flatnonzero(hold_back(np.repeat(["a"], 20))).tolist() == [18, 19]


def test_regression_on_a_sample_is_least_squares() -> None:
    generator = np.random.default_rng(5)
    inputs = generator.standard_normal((500, 3)) * [1, 100, 0.01] + [5, -300, 2]
    label = inputs @ [0.3, -0.002, 4.0] + 0.7 + 0.1 * generator.standard_normal(500)
    design = np.column_stack([np.ones(500), inputs])
    expected = design @ np.linalg.solve(design.T @ design, design.T @ label)
    fitted = fit_regression(inputs, label, two_drives(500))
    np.testing.assert_allclose(fitted.predict(inputs), expected, atol=1e-9)
    assert fitted.size_bytes == 4 * 8


def test_a_kernel_mean_is_the_definition() -> None:
    generator = np.random.default_rng(8)
    rows, centres = generator.standard_normal((7, 2)), generator.standard_normal((5, 2))
    labels = generator.standard_normal(5)
    distance2 = ((rows[:, None] - centres[None]) ** 2).sum(axis=2)
    weights = np.exp(-distance2 / (2 * 0.6**2))
    expected = (weights * labels).sum(axis=1) / weights.sum(axis=1)
    np.testing.assert_allclose(kernel_mean(rows, centres, labels, 0.6), expected, rtol=1e-12)


def test_a_kernel_mean_far_from_everything_is_the_nearest_label() -> None:
    centres = np.array([[0.0], [1.0]])
    far = np.array([[1e4]])
    assert kernel_mean(far, centres, np.array([3.0, 7.0]), 0.1) == pytest.approx(7.0)


def test_a_general_regression_network_follows_a_curve() -> None:
    x = np.linspace(-3, 3, 2 * CENTRES + 500)[:, None]
    fitted = fit_general_regression(x, np.sin(x[:, 0]), two_drives(len(x)))
    inside = np.abs(x[:, 0]) < 2.5
    np.testing.assert_allclose(fitted.predict(x)[inside], np.sin(x[inside, 0]), atol=0.03)


def test_a_perceptron_carries_the_parameters_of_its_layers() -> None:
    data = sample(400)
    fitted = fit_perceptron(data.inputs, data.sideslip_rad, data.trip)
    first, second = LAYERS
    weights = (8 * first + first) + (first * second + second) + (second + 1)
    scaling = 2 * 8 + 2
    assert fitted.size_bytes == 4 * weights + 8 * scaling


def test_what_a_network_and_trees_stop_by_is_not_learned_from() -> None:
    """Labels of the drives held back are another law; who learned from them would follow it."""
    data = sample()
    held = hold_back(data.trip)
    label = np.where(held, 5.0, data.sideslip_rad)
    for fit in (fit_perceptron, fit_trees):
        far = fit(data.inputs, label, data.trip).predict(data.inputs[held])
        assert np.abs(far).max() < 1.0


@pytest.mark.parametrize("learner", LEARNERS, ids=lambda learner: learner.name)
def test_every_learner_learns(learner: Learner) -> None:
    rival = train(learner, sample(), Inputs.of_signals(all_signals()), "8")
    spread_deg = float(np.degrees(sample().sideslip_rad.std()))
    figures = rival.cross_validated
    assert figures.coverage == 1
    assert figures.error_std_deg is not None
    assert figures.error_std_deg < 0.75 * spread_deg
    assert rival.training_s > 0
    assert rival.size_bytes > 0


def test_no_fold_is_tested_on_drives_that_it_was_fitted_on() -> None:
    """A learner that remembers labels by drive must fail on drives that it has not seen."""
    data = sample()
    number = np.array([int(name.removeprefix("drive-")) for name in data.trip])
    seen: list[set[int]] = []

    def remember(inputs: FloatArray, label: FloatArray, trip: Names) -> FittedLearner:
        assert {f"drive-{n:.0f}" for n in inputs[:, 0]} == set(trip)
        seen.append(set(inputs[:, 0].astype(int)))
        return fit_regression(inputs, label, trip)

    learner = Learner("memory", "", remember)
    folds = by_hash(data.trip.tolist(), 5)
    cross_validate_learner(learner, number[:, None].astype(float), data, folds)
    assert len(seen) == len(folds.names)
    for fold, fitted_on in enumerate(seen):
        assert not fitted_on & set(number[folds.fold == fold])


def test_a_null_input_leaves_no_estimate() -> None:
    inputs = Inputs.of_signals(TWO_SIGNALS)
    rival = train(LEARNERS[0], sample(), inputs, "2")
    signals = {
        catalogue()[name].column: np.array([0.5, np.nan, 0.5]) for name in catalogue().inputs
    }
    assert np.isfinite(rival.estimate(signals)).tolist() == [True, False, True]
