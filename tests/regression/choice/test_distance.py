"""The distance D of equation (2) against its definition on the rows, and against simulation."""

import numpy as np
import pytest

from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.inference import Evidence
from tests.support.counts import gram_of

ORDER = ("x1", "x2", "x3", "x4")


def project(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    design = np.column_stack([np.ones(len(x)), x])
    return np.asarray(design @ np.linalg.lstsq(design, y, rcond=None)[0])


def drawn(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and the label without noise, in counts; the last two signals have no effect."""
    x = np.rint(rng.normal(0, 1000, (200, 4)) + rng.normal(0, 500, (200, 1)))
    return x, 0.04 * x[:, 0] - 0.02 * x[:, 1]


def evidence_of(x: np.ndarray, y: np.ndarray) -> Evidence:
    gram = gram_of(np.column_stack([x, y]).astype(np.int64))
    return Evidence.naive(nested_fits(gram, ORDER, "y"))


def test_the_distance_to_the_full_model_is_that_of_the_predictions() -> None:
    rng = np.random.default_rng(1)
    x, truth = drawn(rng)
    y = np.rint(truth + rng.normal(0, 30, 200))
    full = project(x, y)
    variance = np.sum((y - full) ** 2) / (200 - 5)
    distances = [np.sum((full - project(x[:, :j], y)) ** 2) / variance for j in range(5)]
    np.testing.assert_allclose(evidence_of(x, y).excess(), distances, rtol=1e-9, atol=1e-9)


def test_the_expected_distance_is_what_the_true_model_is_away_on_average() -> None:
    """The constant is fitted by every model, and costs each of them one more."""
    rng = np.random.default_rng(2)
    x, truth = drawn(rng)
    estimated, real = np.zeros(5), np.zeros(5)
    trials = 400
    for _ in range(trials):
        y = np.rint(truth + rng.normal(0, 30, 200))
        estimated += np.array(evidence_of(x, y).distances()) / trials
        away = [np.sum((truth - project(x[:, :j], y)) ** 2) / 30**2 for j in range(5)]
        real += (np.array(away) - 1) / trials
    assert real[:2].min() > 50
    assert estimated == pytest.approx(real, rel=0.04, abs=0.3)
