"""Does an estimate of the side-slip angle help a stability control that brakes single wheels?

    python -m benchmarks.stability_control [--record 80] [--trials 60] [--seed 0]

Some sines with dwell are driven with a control that knows yaw rate alone, and recorded as logs with
a reference angle. The logs are ingested and train the models of Table I. Then other trials are
driven by four controls: none, by yaw rate, and by yaw rate and angle: the estimated, and the true.
"""

import argparse
import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import fleet_slip
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.export.estimator import Estimator
from fleet_slip.simulation import environment
from fleet_slip.vehicle.driver import handling
from fleet_slip.vehicle.parameters import load_vehicle

Sample = Mapping[str, float]
Angle = Callable[[Sample, Mapping[str, Any]], float]
"""What the control takes for the side-slip angle in rad."""

SLACK_RAD_S = 0.06
"""Error of the yaw rate that is left alone."""
SHARE_PER_RAD_S = 3.0
SLACK_RAD = math.radians(2.5)
SHARE_PER_RAD = 8.0
GRIP_SHARE = 1.15
"""How much faster than its lateral acceleration allows a car may be asked to turn."""
LEAST_MPS2 = 3.0


@dataclass(frozen=True)
class Control:
    """Brakes the outer front wheel where the car turns too fast, or its rear slides.

    `angle` is None for a control by yaw rate alone.
    """

    angle: Angle | None = None

    def act(self, sample: Sample, info: Mapping[str, Any]) -> environment.Observation:
        """Return the brakes for the next tick."""
        rolling = 1 / CAR.tyre.rolling_radius_m
        wheels = [sample[f"wheel_{name}_rad_s"] for name in environment.WHEELS]
        speed = max(float(np.mean(wheels)) / rolling, 2.0)
        steer = (sample["steer_fl_rad"] + sample["steer_fr_rad"]) / 2
        asked = speed * steer / (HANDLING.wheelbase + HANDLING.understeer * speed**2)
        most = GRIP_SHARE * max(abs(sample["ay_mps2"]), LEAST_MPS2) / speed
        error = sample["yaw_rate_rad_s"] - min(max(asked, -most), most)
        turn = -SHARE_PER_RAD_S * beyond(error, SLACK_RAD_S)  # to the left, as a share of a brake
        if self.angle is not None:
            turn += SHARE_PER_RAD * beyond(self.angle(sample, info), SLACK_RAD)
        brakes = np.zeros(len(environment.WHEELS), dtype=np.float32)
        brakes[0 if turn > 0 else 1] = min(abs(turn), 1.0)
        return brakes


def beyond(value: float, slack: float) -> float:
    """Return how far a value is beyond ±slack."""
    return math.copysign(max(abs(value) - slack, 0.0), value)


def nothing(_: Sample, __: Mapping[str, Any]) -> environment.Observation:
    return np.zeros(len(environment.WHEELS), dtype=np.float32)


@dataclass(frozen=True)
class Driven:
    """One episode: samples in SI units with the true angle, and whether the car spun."""

    samples: list[dict[str, float]]
    spun: bool

    @property
    def peak_deg(self) -> float:
        return math.degrees(max(abs(one["sideslip_rad"]) for one in self.samples))


CAR = load_vehicle("d_class_sedan")
HANDLING = handling(CAR)
COLUMNS = [catalogue()[name].column for name in catalogue().inputs]


def drive(seed: int, act: Callable[[Sample, Mapping[str, Any]], Any]) -> Driven:
    """Drive the trial of a seed; its car, its noise and its road are the same for all controls."""
    env = gymnasium.make("fleet_slip/SideSlip-v0")
    seen, info = env.reset(seed=seed)
    samples: list[dict[str, float]] = []
    lost = over = False
    while not (lost or over):
        sample = dict(zip(COLUMNS, map(float, seen), strict=True))
        samples.append({**sample, "sideslip_rad": info["sideslip_rad"]})
        seen, _, lost, over, info = env.step(act(sample, info))
    return Driven(samples, bool(lost))


MAPPING = """
name = "trials"
[time]
rate_hz = 100
[drive]
column = "trial"
day = 2026-10-01
vehicle_id = { column = "trial" }
vehicle_model = "d_class_sedan"
[signals]
"""


def train(folder: Path, record: int, seed: int) -> Estimator:
    """Record trials as logs and return what the best model of Table I makes of them."""
    lines = [
        f'{name} = {{ column = "{one.column}", unit = "{one.unit}" }}'
        for name, one in catalogue().signals.items()
        if one.role in ("input", "label")
    ]
    (folder / "trials.toml").write_text(MAPPING + "\n".join(lines) + "\n")
    rows = [
        {"trial": f"trial-{k}", **sample}
        for k in range(record)
        for sample in drive(seed + k, Control().act).samples
    ]
    pq.write_table(pa.Table.from_pylist(rows), folder / "trials.parquet")
    fleet = fleet_slip.open(folder / "data")
    fleet.ingest(folder / "trials.parquet", str(folder / "trials.toml"))
    fleet.gram()
    selection = fleet.cohort().select(models="table1")
    made = fleet.publish("trials", selection, force=True).version.manifest
    figures = made.cross_validation
    print(
        f"{made.trained_on.drives} trials, {made.trained_on.rows:,} rows; model "
        f"{made.selected_by.model}: correlation {figures.correlation:.4f}, "
        f"RMSE {figures.rmse_deg:.2f} deg"
    )
    return fleet.estimator("trials")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", type=int, default=80)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        estimator = train(Path(name), arguments.record, arguments.seed)

    def estimated(sample: Sample, _: Mapping[str, Any]) -> float:
        return estimator.step(sample) or 0.0

    def true(_: Sample, info: Mapping[str, Any]) -> float:
        return float(info["sideslip_rad"])

    controls = {
        "none": nothing,
        "yaw rate": Control().act,
        "yaw rate and estimated angle": Control(estimated).act,
        "yaw rate and true angle": Control(true).act,
    }
    first = arguments.seed + arguments.record
    print(f"{'control':<30} {'spun':>6} {'peak angle, deg: median':>24} {'90 %':>6}")
    for title, act in controls.items():
        driven = []
        for seed in range(first, first + arguments.trials):
            estimator.restart()
            driven.append(drive(seed, act))
        peaks = sorted(one.peak_deg for one in driven)
        print(
            f"{title:<30} {sum(one.spun for one in driven):>3}/{len(driven)} "
            f"{median(peaks):>24.1f} {peaks[int(0.9 * len(peaks))]:>6.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
