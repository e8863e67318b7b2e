"""The learners: how each is fitted to a sample, and how much a car would have to carry of it."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.extras import needed

SEED = 0


@dataclass(frozen=True)
class Fitted:
    """A fitted learner: (rows, columns) to side-slip in rad, and the bytes of its parameters."""

    predict: Callable[[FloatArray], FloatArray]
    size_bytes: int


@dataclass(frozen=True)
class Learner:
    """A way to fit inputs (rows, columns) to side-slip angles (rows,)."""

    name: str
    description: str
    fit: Callable[[FloatArray, FloatArray], Fitted]


@dataclass(frozen=True)
class Scaling:
    """Maps columns to mean 0 and standard deviation 1."""

    mean: FloatArray
    std: FloatArray

    @classmethod
    def of(cls, values: FloatArray) -> "Scaling":
        """Return the scaling of a sample."""
        return cls(values.mean(axis=0), np.maximum(values.std(axis=0), np.finfo(float).tiny))

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return the scaled values."""
        return (values - self.mean) / self.std

    @property
    def size_bytes(self) -> int:
        """Bytes of mean and standard deviation."""
        return int(np.asarray(self.mean).nbytes + np.asarray(self.std).nbytes)


def fit_regression(inputs: FloatArray, label: FloatArray) -> Fitted:
    """Fit by ordinary least squares, as equation (4) does, on the rows of the sample."""
    centre = inputs.mean(axis=0)
    weights = np.linalg.lstsq(inputs - centre, label - label.mean(), rcond=None)[0]
    intercept = float(label.mean() - centre @ weights)

    def predict(rows: FloatArray) -> FloatArray:
        estimate: FloatArray = rows @ weights + intercept
        return estimate

    return Fitted(predict, int(weights.nbytes) + 8)


PASSES = 60
"""Passes over the sample that a network may take."""


def fit_perceptron(inputs: FloatArray, label: FloatArray) -> Fitted:
    """Fit a network with two hidden layers of 16 neurons, on scaled inputs and label.

    It stops when a tenth of the rows, held back, is not estimated better for five passes over the
    others, or after `PASSES`.
    """
    network = _scikit_learn("neural_network").MLPRegressor(
        hidden_layer_sizes=(16, 16),
        activation="tanh",
        batch_size=256,
        learning_rate_init=1e-2,
        early_stopping=True,
        n_iter_no_change=5,
        max_iter=PASSES,
        random_state=SEED,
    )
    scaling, of_label = Scaling.of(inputs), Scaling.of(label)
    with warnings.catch_warnings():
        # That the passes are used up is no news.
        warnings.simplefilter("ignore")
        network.fit(scaling(inputs), of_label(label))

    def predict(rows: FloatArray) -> FloatArray:
        estimate: FloatArray = network.predict(scaling(rows)) * of_label.std + of_label.mean
        return estimate

    parameters = sum(array.nbytes for array in (*network.coefs_, *network.intercepts_))
    return Fitted(predict, int(parameters) + scaling.size_bytes + of_label.size_bytes)


def fit_trees(inputs: FloatArray, label: FloatArray) -> Fitted:
    """Fit gradient-boosted trees: 200 of them with at most 31 leaves each."""
    trees = _scikit_learn("ensemble").HistGradientBoostingRegressor(
        max_iter=200, early_stopping=False, random_state=SEED
    )
    trees.fit(inputs, label)
    # scikit-learn shows the nodes of these trees nowhere else.
    nodes = sum(tree.nodes.nbytes for stage in trees._predictors for tree in stage)
    return Fitted(trees.predict, int(nodes))


CENTRES = 1000
"""Rows that the general regression network remembers."""

BANDWIDTHS = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)
"""Widths of its kernel to choose from, in standard deviations of the inputs."""


def fit_general_regression(inputs: FloatArray, label: FloatArray) -> Fitted:
    """Fit a general regression network (Specht 1991): a mean of remembered labels.

    Each remembered row counts with exp(−d²/2h²), d its distance in scaled inputs. The width h is
    the one that estimates rows that are not remembered best.
    """
    scaling = Scaling.of(inputs)
    order = np.random.default_rng(SEED).permutation(len(inputs))
    kept, others = order[:CENTRES], order[CENTRES : 2 * CENTRES]
    centres, labels = scaling(inputs[kept]), label[kept]

    def error(width: float) -> float:
        estimate = kernel_mean(scaling(inputs[others]), centres, labels, width)
        return float(np.mean((estimate - label[others]) ** 2))

    width = min(BANDWIDTHS, key=error)
    return Fitted(
        lambda rows: kernel_mean(scaling(rows), centres, labels, width),
        int(centres.nbytes + labels.nbytes) + scaling.size_bytes + 8,
    )


BLOCK = 2048


def kernel_mean(
    rows: FloatArray, centres: FloatArray, labels: FloatArray, width: float
) -> FloatArray:
    """Return the mean of labels at rows, weighted by Gaussian kernels around the centres.

    The nearest centre always counts, however far it is.
    """
    half = (centres**2).sum(axis=1) / 2
    estimates = np.empty(len(rows))
    for first in range(0, len(rows), BLOCK):
        # −d²/2 but for a term that is the same for all centres of a row, which cancels.
        closeness = (rows[first : first + BLOCK] @ centres.T - half) / width**2
        weights = np.exp(closeness - closeness.max(axis=1, keepdims=True))
        estimates[first : first + BLOCK] = weights @ labels / weights.sum(axis=1)
    return estimates


LEARNERS = (
    Learner("regression", "ordinary least squares", fit_regression),
    Learner("mlp", "multilayer perceptron, 2 layers of 16", fit_perceptron),
    Learner("trees", "200 gradient-boosted trees", fit_trees),
    Learner("grnn", "general regression network", fit_general_regression),
)


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep numerical libraries to one thread: a car has few, and waiting for each other costs more.

    Raises `ConfigError` if scikit-learn is not installed.
    """
    # The limit holds for libraries that are loaded.
    _require_scikit_learn()
    with import_module("threadpoolctl").threadpool_limits(limits=1):
        yield


def _require_scikit_learn() -> None:
    _scikit_learn("ensemble")


def _scikit_learn(module: str) -> Any:
    with needed("rivals", "training the rivals"):
        return import_module(f"sklearn.{module}")
