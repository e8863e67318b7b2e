"""What a recurrent learner reaches on the test drives: an echo-state network, Jaeger (2001).

    python -m benchmarks.reservoir ROOT MODEL [--rows 600000] [--neurons 200] [--drives A,B]

    x ← x + a (tanh(W x + V u) − x),    side-slip = w · [1, u, x]

with the scaled signals u of model 4 of Table I. W, V and the leaks a, of which each neuron has its
own, are drawn; w is fitted by ridge regression to about so many rows of the model's drives. How
strong V is, and the ridge, are chosen by drives held back. scikit-learn, which trains the other
rivals, has no recurrent networks, and what trains them brings a framework of tensors.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import fleet_slip
from benchmarks.learners import DRIVES
from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.comparison.evaluation.evaluated_drives import simulate_drives
from fleet_slip.comparison.evaluation.scenario_runs import error_figures
from fleet_slip.comparison.rivals.compare import all_signals
from fleet_slip.comparison.rivals.learner import SEED, hold_back, one_thread
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.simulation.scenario import load_scenario

RADIUS = 0.95
"""Spectral radius of W: below 1 what was is forgotten."""

LEAKS = (0.003, 1.0)
"""Of a step of 10 ms: memories from 3 s to none."""

STRENGTHS = (0.1, 0.3)
RIDGES = tuple(10.0**power for power in range(-9, 0))


class Reservoir:
    """The neurons that are drawn, and their states in some drives at once."""

    def __init__(self, neurons: int, inputs: int, strength: float) -> None:
        """Draw a reservoir for so many inputs."""
        random = np.random.default_rng(SEED)
        inner = random.normal(size=(neurons, neurons)) * (random.random((neurons, neurons)) < 0.1)
        inner *= RADIUS / np.abs(np.linalg.eigvals(inner)).max()
        outer = random.uniform(-strength, strength, (neurons, inputs + 1))
        self.weights = np.hstack([inner, outer]).T.astype(np.float32)
        self.leak = np.exp(random.uniform(np.log(LEAKS[0]), np.log(LEAKS[1]), neurons)).astype(
            np.float32
        )

    def rows(
        self, drives: Sequence[FloatArray], every: int
    ) -> Iterator[tuple[int, BoolArray, FloatArray]]:
        """Yield (tick, which drives go on, their [1, u, x]) at every so many-th tick."""
        longest = max(len(one) for one in drives)
        lengths = np.array([len(one) for one in drives])
        inputs = np.zeros((longest, len(drives), drives[0].shape[1] + 1), np.float32)
        inputs[:, :, 0] = 1.0
        for place, one in enumerate(drives):
            inputs[: len(one), place, 1:] = one
        states = np.zeros((len(drives), len(self.leak)), np.float32)
        for tick in range(longest):
            told = np.hstack([states, inputs[tick]])
            states += self.leak * (np.tanh(told @ self.weights) - states)
            if tick % every == 0:
                going = tick < lengths
                yield tick, going, np.hstack([inputs[tick], states])[going].astype(np.float64)


def main() -> None:
    """Fit the network and print its errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("model")
    parser.add_argument("--rows", type=int, default=600_000)
    parser.add_argument("--neurons", type=int, default=200)
    parser.add_argument("--drives", default=",".join(DRIVES))
    asked = parser.parse_args()
    fleet = fleet_slip.open(asked.root)
    cohort = load_cohort(fleet.warehouse, fleet.model(asked.model).manifest.trained_on.cohort)
    names = [catalogue()[one].column for one in all_signals()]
    trips = np.unique(cohort.drives["drive_id"].to_pylist())
    logged = _read(fleet, [*names, catalogue()[catalogue().label].column], trips.tolist())
    mean, std = np.concatenate(logged).mean(axis=0), np.concatenate(logged).std(axis=0)
    drives = [((one - mean) / std)[:, :-1] for one in logged]
    labels = [one[:, -1] - mean[-1] for one in logged]
    every = max(1, cohort.rows // asked.rows)
    with one_thread():
        reservoir, weights = _choose(drives, labels, hold_back(trips), every, asked.neurons)
        for one in simulate_drives([load_scenario(name) for name in asked.drives.split(",")]):
            seen = (np.column_stack([one.signals[n] for n in names]) - mean[:-1]) / std[:-1]
            states = np.concatenate([rows for *_, rows in reservoir.rows([seen], 1)])
            found = error_figures(states @ weights + mean[-1], one.sideslip_rad, one.evaluated)
            print(f"| reservoir | {one.scenario.name} | {found.rmse_deg:.4f} |", flush=True)
    print(f"reservoir: {reservoir.weights.nbytes + reservoir.leak.nbytes + weights.nbytes:,} bytes")


def _read(
    fleet: fleet_slip.Fleet, columns: Sequence[str], drives: Sequence[str]
) -> list[FloatArray]:
    """Return columns of each drive, shape (rows, columns)."""
    query = f"SELECT {', '.join(columns)} FROM log WHERE drive_id = '%s' ORDER BY time_s"
    found = [fleet.sql(query % one).fetchnumpy() for one in drives]
    return [np.column_stack([one[name] for name in columns]).astype(np.float64) for one in found]


def _choose(
    drives: Sequence[FloatArray],
    labels: Sequence[FloatArray],
    held: BoolArray,
    every: int,
    neurons: int,
) -> tuple[Reservoir, FloatArray]:
    """Return the reservoir and the ridge's weights that serve drives held back best."""
    found: list[tuple[float, Reservoir, FloatArray]] = []
    for strength in STRENGTHS:
        reservoir = Reservoir(neurons, drives[0].shape[1], strength)
        size = neurons + drives[0].shape[1] + 2
        moments = np.zeros((2, size, size))
        for tick, going, rows in reservoir.rows(drives, every):
            label = np.array([one[tick] for one, goes in zip(labels, going, strict=True) if goes])
            both = np.column_stack([rows, label])
            for part in (0, 1):
                some = both[held[going] == part]
                moments[part] += some.T @ some
        for ridge in RIDGES:
            ends = np.append(_fitted(moments[0], ridge), -1.0)
            error = float(np.sqrt(ends @ moments[1] @ ends / moments[1][0, 0]))
            found.append((error, reservoir, _fitted(moments.sum(axis=0), ridge)))
        least = min(one[0] for one in found)
        print(f"V up to {strength}: {np.degrees(least):.4f} deg on drives held back", flush=True)
    _, reservoir, weights = min(found, key=lambda one: one[0])
    return reservoir, weights


def _fitted(moments: FloatArray, ridge: float) -> FloatArray:
    """Return the weights of the first columns for the last one, from sums of products."""
    normal, slope = moments[:-1, :-1], moments[:-1, -1]
    damping = ridge * np.trace(normal) / len(normal) * np.eye(len(normal))
    found: FloatArray = np.linalg.solve(normal + damping, slope)
    return found


if __name__ == "__main__":
    main()
