"""A bank of extended Kalman filters, each told another adhesion, weighed by how likely they are.

Multiple-model estimation after Magill, "Optimal adaptive estimation of sampled stochastic
processes", IEEE Transactions on Automatic Control 10 (1965). With l(μ) the log likelihood of a
row's innovations in the filter that believes in μ, forgotten over the time T, and p the prior:

    L ← L + (Δt/T) (l − L)    w(μ) ∝ p(μ) exp(e T/Δt L(μ))    x = Σ w(μ) x(μ)

Innovations at 100 Hz are no independent evidence, because what a model lacks lasts longer than a
row: each counts for e of one.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from pydantic import Field, FiniteFloat

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.observers import ekf
from fleet_slip.comparison.observers.drive_signals import STEP_S, DriveSignals, sideslip_angle
from fleet_slip.comparison.observers.single_track import follow
from fleet_slip.vehicle.parameters import VehicleParameters

ADHESIONS = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2)
"""What the filters believe of the road, the likeliest beforehand first."""


class BankNoise(ekf.EkfNoise):
    """What all filters of the bank share, and how readily it believes another one."""

    memory_s: FiniteFloat = Field(default=30.0, ge=0.1, le=1000.0)
    """How long evidence for an adhesion lasts."""
    evidence: FiniteFloat = Field(default=0.01, ge=1e-4, le=1.0)
    """For how much of an independent row a row counts."""
    odds: FiniteFloat = Field(default=0.01, ge=1e-9, le=1.0)
    """How likely an adhesion is beforehand, over the next higher one."""


TUNABLE = ("memory_s", "evidence", "odds")
"""The parameters that `tuning.tune` should search; the filters' own are those of `ekf`, tuned."""


def weights(likelihoods: FloatArray, noise: BankNoise) -> FloatArray:
    """Return the weight of each filter at each row, from log likelihoods, both (filters, rows)."""
    gain = STEP_S / noise.memory_s
    recent = np.stack([follow(np.append(0.0, one), gain)[1:] for one in likelihoods])
    prior = np.arange(len(recent))[:, None] * np.log(noise.odds)
    total = noise.evidence / gain * recent + prior
    weight = np.exp(total - total.max(axis=0))
    shares: FloatArray = weight / weight.sum(axis=0)
    return shares


def velocities(drive: DriveSignals, car: VehicleParameters, noise: ekf.EkfNoise) -> FloatArray:
    """Return what `ekf.velocity` does of each filter, (filters, 3, rows)."""
    told = [noise.model_copy(update={"adhesion": one}) for one in ADHESIONS]
    return np.stack([ekf.velocity(drive, car, one) for one in told])


def together(found: FloatArray, noise: BankNoise) -> FloatArray:
    """Return side-slip in rad of the filters' weighed velocities."""
    share = weights(found[:, 2], noise)
    return sideslip_angle((share * found[:, 0]).sum(axis=0), (share * found[:, 1]).sum(axis=0))


def estimate(drive: DriveSignals, car: VehicleParameters, noise: BankNoise) -> FloatArray:
    """Estimate side-slip in rad by row."""
    return together(velocities(drive, car, noise), noise)


def remembering() -> Callable[[DriveSignals, VehicleParameters, Any], FloatArray]:
    """Return `estimate` for a search of `TUNABLE` alone: what the filters find stays the same."""
    kept: dict[int, tuple[DriveSignals, FloatArray]] = {}

    def from_memory(drive: DriveSignals, car: VehicleParameters, noise: BankNoise) -> FloatArray:
        if id(drive) not in kept:
            kept[id(drive)] = drive, velocities(drive, car, noise)
        return together(kept[id(drive)][1], noise)

    return from_memory
