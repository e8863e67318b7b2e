"""The learners: how each is fitted to a sample, and how much a car would have to carry of it."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.neural_network import MLPRegressor
from threadpoolctl import threadpool_limits

from fleet_slip.arrays import BoolArray, FloatArray

SEED = 0

Names = NDArray[np.str_]
"""The drive of each row, shape (rows,)."""


@dataclass(frozen=True)
class FittedLearner:
    """A fitted learner: (rows, columns) to side-slip in rad, and the bytes of its parameters."""

    predict: Callable[[FloatArray], FloatArray]
    size_bytes: int


Fit = Callable[[FloatArray, FloatArray, Names], FittedLearner]
"""A way to fit inputs (rows, columns) of some drives to side-slip angles (rows,)."""


@dataclass(frozen=True)
class Scaling:
    """Maps columns to mean 0 and standard deviation 1."""

    mean: FloatArray
    std: FloatArray

    @classmethod
    def fit(cls, values: FloatArray) -> "Scaling":
        """Return the scaling of a sample."""
        return cls(values.mean(axis=0), np.maximum(values.std(axis=0), np.finfo(float).tiny))

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return the scaled values."""
        return (values - self.mean) / self.std

    @property
    def size_bytes(self) -> int:
        """Bytes of mean and standard deviation."""
        return int(np.asarray(self.mean).nbytes + np.asarray(self.std).nbytes)


HELD_BACK = 8
"""Every so many drives one is held back, by which a learner sees when to stop."""


def hold_back(trip: Names) -> BoolArray:
    """Return which rows to stop by: those of whole drives; with one drive its last tenth."""
    drives = np.unique(trip)
    if len(drives) > 1:
        step = min(HELD_BACK, len(drives))
        return np.isin(trip, drives[step // 2 :: step])
    return np.arange(len(trip)) >= 0.9 * len(trip)


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep numerical libraries to one thread, as on board."""
    with threadpool_limits(limits=1):
        yield


BLOCK = 2048
LAYERS = (64, 64)
BATCH_ROWS = 256
RATES = (3e-3, 1e-3, 3e-4, 1e-4)
"""Learning rates, one after the other: each until the drives held back are estimated no better."""

PASSES_AT_ONCE = 3
PASSES = 60
"""Passes over the sample, at most."""


def fit_perceptron(inputs: FloatArray, label: FloatArray, trip: Names) -> FittedLearner:
    """Fit two hidden layers of 64 neurons by Adam; keep the weights best on drives held back."""
    network = MLPRegressor(
        hidden_layer_sizes=LAYERS, activation="tanh", batch_size=BATCH_ROWS,
        max_iter=PASSES_AT_ONCE, tol=0.0, warm_start=True, random_state=SEED,
    )  # fmt: skip
    scaling, label_scaling = Scaling.fit(inputs), Scaling.fit(label)
    scaled, targets = scaling(inputs).astype(np.float32), label_scaling(label).astype(np.float32)
    held = hold_back(trip)
    least, best, passes = np.inf, None, 0
    for rate in RATES:
        network.set_params(learning_rate_init=rate)
        better = True
        while better and passes < PASSES:
            with warnings.catch_warnings():
                # A few passes are not expected to converge.
                warnings.simplefilter("ignore")
                network.fit(scaled[~held], targets[~held])
            passes += PASSES_AT_ONCE
            error = float(np.mean((network.predict(scaled[held]) - targets[held]) ** 2))
            better = error < least
            if better:
                least = error
                best = [array.copy() for array in (*network.coefs_, *network.intercepts_)]
        if best is not None:
            layers = len(LAYERS) + 1
            network.coefs_ = [array.copy() for array in best[:layers]]
            network.intercepts_ = [array.copy() for array in best[layers:]]

    def predict(rows: FloatArray) -> FloatArray:
        predictions: FloatArray = network.predict(scaling(rows).astype(np.float32)).astype(
            np.float64
        )
        return predictions * label_scaling.std + label_scaling.mean

    parameters = sum(array.nbytes for array in (*network.coefs_, *network.intercepts_))
    return FittedLearner(predict, int(parameters) + scaling.size_bytes + label_scaling.size_bytes)


CENTRES = 1000
"""Rows that the general regression network remembers."""

BANDWIDTHS = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)
"""Widths of its kernel to choose from, in standard deviations of the inputs."""


def fit_general_regression(inputs: FloatArray, label: FloatArray, trip: Names) -> FittedLearner:
    """Fit a general regression network (Specht 1991): a mean of remembered labels.

    Each remembered row counts with exp(−d²/2h²), d its distance in scaled inputs. The width h is
    the one that estimates drives best which are not remembered.
    """
    scaling = Scaling.fit(inputs)
    held = hold_back(trip)
    order = np.random.default_rng(SEED).permutation(len(inputs))
    training, validation = order[~held[order]][:CENTRES], order[held[order]][:CENTRES]
    centres, labels = scaling(inputs[training]), label[training]

    def error(width: float) -> float:
        estimate = kernel_mean(scaling(inputs[validation]), centres, labels, width)
        return float(np.mean((estimate - label[validation]) ** 2))

    width = min(BANDWIDTHS, key=error)
    return FittedLearner(
        lambda rows: kernel_mean(scaling(rows), centres, labels, width),
        int(centres.nbytes + labels.nbytes) + scaling.size_bytes + 8,
    )


def kernel_mean(
    rows: FloatArray, centres: FloatArray, labels: FloatArray, width: float
) -> FloatArray:
    """Return the mean of labels, weighted by Gaussian kernels; the nearest centre always counts."""
    half = (centres**2).sum(axis=1) / 2
    estimates = np.empty(len(rows))
    for first in range(0, len(rows), BLOCK):
        # −d²/2 but for a term that is the same for all centres of a row, which cancels.
        closeness = (rows[first : first + BLOCK] @ centres.T - half) / width**2
        weights = np.exp(closeness - closeness.max(axis=1, keepdims=True))
        estimates[first : first + BLOCK] = weights @ labels / weights.sum(axis=1)
    return estimates


def fit_regression(inputs: FloatArray, label: FloatArray, _: Names) -> FittedLearner:
    """Fit by ordinary least squares, as equation (4) does, on the rows of the sample."""
    centre = inputs.mean(axis=0)
    weights = np.linalg.lstsq(inputs - centre, label - label.mean(), rcond=None)[0]
    intercept = float(label.mean() - centre @ weights)

    def predict(rows: FloatArray) -> FloatArray:
        estimate: FloatArray = rows @ weights + intercept
        return estimate

    return FittedLearner(predict, int(weights.nbytes) + 8)


MOST_TREES = 500


def fit_trees(inputs: FloatArray, label: FloatArray, trip: Names) -> FittedLearner:
    """Fit gradient-boosted trees of at most 31 leaves, as many as drives held back ask for."""
    trees = HistGradientBoostingRegressor(
        learning_rate=0.1, max_iter=MOST_TREES, early_stopping=True, n_iter_no_change=20,
        tol=0.0, random_state=SEED,
    )  # fmt: skip
    held = hold_back(trip)
    trees.fit(inputs[~held], label[~held], X_val=inputs[held], y_val=label[held])
    # scikit-learn shows the nodes of these trees nowhere else.
    nodes = sum(tree.nodes.nbytes for stage in trees._predictors for tree in stage)
    return FittedLearner(trees.predict, int(nodes))
