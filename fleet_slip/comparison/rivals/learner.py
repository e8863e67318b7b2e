"""What a learner is, and what learners share: scaling, drives held back, one thread."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.extras import needed

SEED = 0

Names = NDArray[np.str_]
"""The drive of each row, shape (rows,)."""


@dataclass(frozen=True)
class FittedLearner:
    """A fitted learner: (rows, columns) to side-slip in rad, and the bytes of its parameters."""

    predict: Callable[[FloatArray], FloatArray]
    size_bytes: int


@dataclass(frozen=True)
class Learner:
    """A way to fit inputs (rows, columns) of some drives to side-slip angles (rows,)."""

    name: str
    description: str
    fit: Callable[[FloatArray, FloatArray, Names], FittedLearner]


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


HELD_BACK = 8
"""Every so many drives one is held back, by which a learner sees when to stop."""


def hold_back(trip: Names) -> BoolArray:
    """Return which rows to stop by: those of whole drives; with one drive its last tenth."""
    drives = np.unique(trip)
    if len(drives) > 1:
        every = min(HELD_BACK, len(drives))
        return np.isin(trip, drives[every // 2 :: every])
    return np.arange(len(trip)) >= 0.9 * len(trip)


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep numerical libraries to one thread, as on board. Raises `ExtraError`."""
    # The limit holds for libraries that are loaded.
    scikit_learn("ensemble")
    with import_module("threadpoolctl").threadpool_limits(limits=1):
        yield


def scikit_learn(module: str) -> Any:
    """Return a module of scikit-learn. Raises `ExtraError` if it is not installed."""
    with needed("rivals", "training the rivals"):
        return import_module(f"sklearn.{module}")
