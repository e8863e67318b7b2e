"""A Kalman filter with a decision tree: the tree says how far the model can be trusted.

After Coyte et al., "Decision tree assisted EKF for vehicle slip angle estimation using inertial
motion sensors", International Joint Conference on Neural Networks (2014): a tree sorts the inertial
signals into kinds of driving, and each kind has error covariances of its own. Here the filter is
`ekf_class`, tuned. A regression tree parts the training rows by how far that filter is off; the
variance of the model's errors in each of its leaves is then sought like every other parameter.
"""

import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.comparison.evaluation.estimators import Signals
from fleet_slip.comparison.evaluation.evaluate import Rival
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.evaluation.filters import FilterEstimate, seen
from fleet_slip.comparison.evaluation.scenario_runs import error_figures
from fleet_slip.comparison.observers import ekf
from fleet_slip.comparison.observers.drive_signals import DriveSignals, LabelledDrive, hold_last
from fleet_slip.comparison.observers.single_track import follow, measured_speed_mps
from fleet_slip.comparison.observers.tuning import tune
from fleet_slip.comparison.rivals.learner import SEED, scikit_learn
from fleet_slip.config import Config
from fleet_slip.vehicle.parameters import VehicleParameters

NAME = "ekf_tree"
BASE = "ekf_class_tuned"
"""The filter whose noise the tree changes."""

FOLDS = 4
"""Into so many parts the drives are divided; each is judged by a tree that has not seen it."""

LEAVES = 6
LEAST_SHARE = 0.01
"""Of the rows, in each leaf."""

LAG = 0.05
"""Share of a new sample in the inertial signals that the tree sees: they follow within 0.2 s."""

SIGNALS = ("ax", "ay", "yaw_rate", "wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr", "steer_fl",
           "steer_fr")  # fmt: skip


class LeafNoise(Config):
    """Variance of the model's errors in each leaf, over that of the filter."""

    leaf_0: FiniteFloat = Field(default=1.0, ge=1e-3, le=1e4)
    leaf_1: FiniteFloat = Field(default=1.0, ge=1e-3, le=1e4)
    leaf_2: FiniteFloat = Field(default=1.0, ge=1e-3, le=1e4)
    leaf_3: FiniteFloat = Field(default=1.0, ge=1e-3, le=1e4)
    leaf_4: FiniteFloat = Field(default=1.0, ge=1e-3, le=1e4)
    leaf_5: FiniteFloat = Field(default=1.0, ge=1e-3, le=1e4)

    @property
    def factors(self) -> FloatArray:
        """The leaves' factors, shape (leaves,)."""
        return np.array(list(self.model_dump().values()))


def kinds(drive: DriveSignals, car: VehicleParameters) -> FloatArray:
    """Return what tells kinds of driving apart, shape (rows, 4): |ax|, |ay|, |r| and |ay − r vx|.

    The last is how fast the car slides sideways, and what its biases leave. Raises `DataError` if
    a sensor is absent.
    """
    ax, ay = hold_last(drive.ax_mps2, "ax"), hold_last(drive.ay_mps2, "ay")
    turning = hold_last(drive.yaw_rate_rad_s, "yaw rate")
    sliding = ay - turning * measured_speed_mps(drive, car)
    return np.stack([np.abs(follow(x, LAG)) for x in (ax, ay, turning, sliding)], axis=1)


@dataclass(frozen=True)
class TreeFilter:
    """The filter `base` with scikit-learn's tree on `kinds`: nodes of its leaves, noise of each."""

    base: FilterEstimate
    tree: Any
    leaves: IntArray
    noise: LeafNoise

    def in_drive(self, drive: EvaluatedDrive) -> "TreeFilter":
        """Return the filter in the car of a drive."""
        return replace(self, base=self.base.in_drive(drive))

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the estimate at each tick."""
        return self.estimate(seen(signals), self.base.car, self.noise)

    def leaf(self, drive: DriveSignals, car: VehicleParameters) -> IntArray:
        """Return the number of the leaf of each row, shape (rows,)."""
        nodes = self.tree.apply(kinds(drive, car).astype(np.float32))
        return np.asarray(np.searchsorted(self.leaves, nodes), dtype=np.int64)

    def estimate(self, drive: DriveSignals, car: VehicleParameters, noise: LeafNoise) -> FloatArray:
        """Estimate side-slip in rad at every row, with these factors."""
        factors = noise.factors[self.leaf(drive, car)]
        parameters = ekf.EkfNoise.model_validate(self.base.parameters.model_dump())
        return ekf.estimate(drive, car, parameters, factors)

    @property
    def size_bytes(self) -> int:
        """Bytes of the tree's nodes and of the leaves' factors."""
        return int(self.tree.tree_.node_count * 24 + self.noise.factors.nbytes)


def fit_tree_filter(
    base: FilterEstimate, drives: Sequence[LabelledDrive], executor: Executor
) -> TreeFilter:
    """Fit the tree to the filter's squared errors, and the leaves' factors. Raises `ExtraError`."""
    cars = [drive.car or base.car for drive in drives]
    pairs = list(zip(drives, cars, strict=True))
    seen_kinds = np.concatenate([kinds(drive.signals, car) for drive, car in pairs])
    parameters = ekf.EkfNoise.model_validate(base.parameters.model_dump())
    errors = np.concatenate(
        [ekf.estimate(one.signals, car, parameters) - one.sideslip_rad for one, car in pairs]
    )
    known = np.isfinite(errors)
    tree = scikit_learn("tree").DecisionTreeRegressor(
        max_leaf_nodes=LEAVES, min_samples_leaf=LEAST_SHARE, random_state=SEED
    )
    tree.fit(seen_kinds[known], errors[known] ** 2)
    leaves = np.flatnonzero(tree.tree_.children_left < 0)
    start = TreeFilter(base, tree, leaves, LeafNoise())
    names = [f"leaf_{number}" for number in range(len(leaves))]
    found = tune(start.estimate, start.noise, names, drives, base.car, executor)
    return replace(start, noise=found.parameters)


def train_tree_filter(
    base: FilterEstimate, drives: Sequence[LabelledDrive], executor: Executor
) -> Rival:
    """Fit the filter with a tree to drives, and to all but each of them; measure it."""
    started = time.perf_counter()
    fitted = fit_tree_filter(base, drives, executor)
    training_s = time.perf_counter() - started
    started = time.perf_counter()
    for drive in drives:
        fitted.estimate(drive.signals, drive.car or base.car, fitted.noise)
    rows = sum(len(drive.signals) for drive in drives)
    step_s = (time.perf_counter() - started) / rows
    held_out = [drives[fold::FOLDS] for fold in range(min(FOLDS, len(drives)))]
    estimates = [_held_out(base, drives, some, executor) for some in held_out]
    truth = np.concatenate([drive.sideslip_rad for some in held_out for drive in some])
    figures = error_figures(np.concatenate(estimates), truth, np.isfinite(truth))
    return Rival(
        name=NAME,
        learner=f"Kalman filter with a decision tree of {LEAVES} leaves",
        estimate=fitted,
        signals=SIGNALS,
        cross_validated=figures,
        rows=rows,
        training_s=training_s,
        size_bytes=fitted.size_bytes,
        one_estimate_us=step_s * 1e6,
        each_of_many_us=step_s * 1e6,
        told={"told": "class", "factors": fitted.noise.model_dump()},
    )


def _held_out(
    base: FilterEstimate,
    drives: Sequence[LabelledDrive],
    some: Sequence[LabelledDrive],
    executor: Executor,
) -> FloatArray:
    """Return the estimates of some drives by a filter that was fitted without them."""
    others = [one for one in drives if all(one is not other for other in some)] or drives
    fitted = fit_tree_filter(base, others, executor)
    return np.concatenate(
        [fitted.estimate(one.signals, one.car or base.car, fitted.noise) for one in some]
    )
