"""A Kalman filter with a decision tree: the tree says how far the model can be trusted.

After Coyte et al., "Decision tree assisted EKF for vehicle slip angle estimation using inertial
motion sensors", International Joint Conference on Neural Networks (2014): a tree sorts the inertial
signals into kinds of driving, and each kind has error covariances of its own. Here the filter is
`ekf_class`, tuned. A regression tree parts the training rows by how far that filter is off; the
variance of the model's errors in each of its leaves is then sought like every other parameter.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field, FiniteFloat
from sklearn.tree import DecisionTreeRegressor

from benchmarks.rivals.learners import SEED
from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.compiling import kernel
from fleet_slip.config import Config
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.ekf import Axles
from fleet_slip.evaluation.evaluated_drives import (
    STEP_S,
    DriveSignals,
    LabelledDrive,
    TestDrive,
    hold_last,
)
from fleet_slip.evaluation.filters import FilterEstimate
from fleet_slip.evaluation.identify import tune
from fleet_slip.evaluation.kalman import (
    follow,
    independent_state,
    measured_speed_mps,
    sideslip_angle,
)
from fleet_slip.vehicle.parameters import VehicleParameters

LEAVES = 6
LEAST_SHARE = 0.01
"""Minimum share of the rows in each leaf."""

LAG = 0.05
"""Share of a new sample in the inertial signals that the tree sees: they follow within 0.2 s."""


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


@kernel
def _filter(inputs: ekf.Inputs, factors: FloatArray) -> FloatArray:
    """Return vx and vy as `ekf` does, the model's variances of each row times a factor."""
    states = np.empty((2, len(inputs.ax_mps2)))
    x, (q_vx, q_vy, q_r, q_bias) = (
        independent_state(inputs.first_mean, inputs.first_variances),
        inputs.q,
    )
    for k in range(len(inputs.ax_mps2)):
        loaded, steer, factor = inputs.axles[:, k], inputs.steer_rad[k], factors[k]
        axles = Axles(loaded[0], loaded[1], loaded[2], loaded[3])
        if k > 0:
            q = q_vx, factor * q_vy, factor * q_r, q_bias
            ekf.predict(x, inputs.ax_mps2[k], steer, STEP_S, axles, inputs.constants, q)
        measured = inputs.vx_mps[k], inputs.yaw_rate_rad_s[k], inputs.ay_mps2[k]
        ekf.update(x, *measured, steer, axles, inputs.constants, inputs.variances)
        states[:, k] = x.mean[:2]
    return states


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

    def __call__(self, drive: TestDrive) -> FloatArray:
        """Return the estimate at each tick."""
        return self.estimate(drive.signals, self.base.car(drive), self.noise)

    def leaf(self, drive: DriveSignals, car: VehicleParameters) -> IntArray:
        """Return the number of the leaf of each row, shape (rows,)."""
        nodes = self.tree.apply(kinds(drive, car).astype(np.float32))
        return np.asarray(np.searchsorted(self.leaves, nodes), dtype=np.int64)

    def estimate(self, drive: DriveSignals, car: VehicleParameters, noise: LeafNoise) -> FloatArray:
        """Estimate side-slip in rad at every row, with these factors."""
        factors = noise.factors[self.leaf(drive, car)]
        parameters = ekf.EkfNoise.model_validate(self.base.parameters.model_dump())
        return sideslip_angle(*_filter(ekf.inputs_of(drive, car, parameters), factors))

    @property
    def size_bytes(self) -> int:
        """Bytes of the tree's nodes and of the leaves' factors."""
        return int(self.tree.tree_.node_count * 24 + self.noise.factors.nbytes)


def fit_tree_filter(
    base: FilterEstimate,
    default_car: VehicleParameters,
    drives: Sequence[LabelledDrive],
    executor: Executor,
) -> TreeFilter:
    """Fit the tree to the filter's squared errors, and the leaves' factors."""
    cars = [drive.car or default_car for drive in drives]
    pairs = list(zip(drives, cars, strict=True))
    seen_kinds = np.concatenate([kinds(drive.signals, car) for drive, car in pairs])
    parameters = ekf.EkfNoise.model_validate(base.parameters.model_dump())
    errors = np.concatenate(
        [
            ekf.estimate(labelled.signals, car, parameters) - labelled.sideslip_rad
            for labelled, car in pairs
        ]
    )
    finite = np.isfinite(errors)
    tree = DecisionTreeRegressor(
        max_leaf_nodes=LEAVES, min_samples_leaf=LEAST_SHARE, random_state=SEED
    )
    tree.fit(seen_kinds[finite], errors[finite] ** 2)
    leaves = np.flatnonzero(tree.tree_.children_left < 0)
    start = TreeFilter(base, tree, leaves, LeafNoise())
    names = [f"leaf_{number}" for number in range(len(leaves))]
    tuned = tune(start.estimate, start.noise, names, drives, default_car, executor)
    return replace(start, noise=tuned.parameters)
