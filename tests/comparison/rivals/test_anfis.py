"""Neuro-fuzzy inference: its algebra, its hybrid learning, and what it makes of a kinked line."""

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.rivals.anfis import Premises, conclude, fit_anfis, infer, learn, scatter

GENERATOR = np.random.default_rng(4)
Z = GENERATOR.standard_normal((400, 2))
X = np.column_stack([GENERATOR.standard_normal((400, 3)), np.ones(400)])
PREMISES = Premises(GENERATOR.standard_normal((3, 2)), 0.3 * GENERATOR.standard_normal((3, 2)))
LABEL = GENERATOR.standard_normal(400)


def test_rules_fire_by_gaussian_memberships_that_add_up_to_one() -> None:
    share = PREMISES.firing(Z)
    width = np.exp(PREMISES.log_width)
    each = np.exp(-0.5 * ((Z[:, None] - PREMISES.centre) / width) ** 2).prod(axis=2)
    np.testing.assert_allclose(share, each / each.sum(axis=1, keepdims=True), rtol=1e-9)


def test_far_from_all_rules_the_nearest_one_fires() -> None:
    close = Premises(np.array([[0.0], [1.0]]), np.zeros((2, 1)))
    np.testing.assert_allclose(close.firing(np.array([[1e4]])), [[0.0, 1.0]])


def test_conclusions_are_those_of_least_squares() -> None:
    share = PREMISES.firing(Z)
    design = (share[:, :, None] * X[:, None, :]).reshape(400, -1)
    expected = np.linalg.lstsq(design, LABEL, rcond=None)[0].reshape(3, 4)
    np.testing.assert_allclose(conclude(share, X, LABEL), expected, rtol=1e-5, atol=1e-7)


def test_the_gradient_is_that_of_finite_differences() -> None:
    conclusions = conclude(PREMISES.firing(Z), X, LABEL)

    def half_error(premises: Premises) -> float:
        error = infer(premises.firing(Z), X, conclusions) - LABEL
        return 0.5 * float(np.mean(error**2))

    h = 1e-6
    by_centre, by_width = PREMISES.gradient(Z, X, conclusions, LABEL)
    for i in range(3):
        for j in range(2):
            moved = np.zeros((3, 2))
            moved[i, j] = h
            up, down = (
                half_error(Premises(PREMISES.centre + s * moved, PREMISES.log_width))
                for s in (1, -1)
            )
            assert by_centre[i, j] == pytest.approx((up - down) / (2 * h), rel=1e-4, abs=1e-9)
            up, down = (
                half_error(Premises(PREMISES.centre, PREMISES.log_width + s * moved))
                for s in (1, -1)
            )
            assert by_width[i, j] == pytest.approx((up - down) / (2 * h), rel=1e-4, abs=1e-9)


def kinked(rows: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return inputs and what saturates beyond ±1 of the first, as a tyre does."""
    inputs = np.random.default_rng(seed).standard_normal((rows, 2)) * [1.5, 1.0]
    return inputs, np.clip(inputs[:, 0], -1, 1) + 0.2 * inputs[:, 1]


def test_hybrid_learning_makes_no_worse_and_betters_rules_that_are_badly_placed() -> None:
    inputs, label = kinked(1000, 1)
    part = (inputs, np.column_stack([inputs, np.ones(1000)]), label)
    bad = Premises(np.array([[0.1, 2.0], [0.0, -2.0], [0.2, 0.0]]), np.zeros((3, 2)))

    def error(premises: Premises) -> float:
        share = premises.firing(part[0])
        return float(np.std(infer(share, part[1], conclude(share, part[1], label)) - label))

    assert error(learn(bad, part, part)) < 0.8 * error(bad)
    good = scatter(inputs)
    assert error(learn(good, part, part)) <= error(good)


def test_a_kinked_line_is_followed_on_rows_that_were_not_learned() -> None:
    inputs, label = kinked(2000, 2)
    names = np.array([f"drive-{i % 10}" for i in range(2000)])
    fitted = fit_anfis(inputs, label, names)
    other, truth = kinked(1000, 3)
    straight = np.linalg.lstsq(np.column_stack([inputs, np.ones(2000)]), label, rcond=None)[0]
    line = np.column_stack([other, np.ones(1000)]) @ straight
    assert np.std(fitted.predict(other) - truth) < 0.35 * np.std(line - truth)
    assert fitted.size_bytes > 8 * 9 * 3
