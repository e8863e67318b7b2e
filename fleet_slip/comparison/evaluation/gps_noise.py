"""The paper's Figure 8: below which noise of satellite navigation its filter is better.

The GPS velocity of one test drive is drawn again from the true one, without outages, with white
noise of several sizes. The filter is told each. The regression, which uses no GPS, stays the same.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.evaluation.filters import FilterEstimate
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario, error_figures
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ

SCENARIO = "nominal"
LEVELS_MPS = (0.01, 0.015, 0.02, 0.025, 0.03, 0.035, 0.04, 0.05, 0.06, 0.08, 0.1)
"""Standard deviations of the GPS velocity, along and across."""

DRAWS = 5
"""Draws of the noise at each level; the same ones, scaled, at all levels."""

SEED = 8
STATED = ("gps_vx_std_mps", "gps_vy_std_mps")
"""The filter's parameters that say how noisy GPS is."""


@dataclass(frozen=True)
class GpsLevel:
    """RMSE in degrees of each filter at one standard deviation of the GPS velocity."""

    velocity_std_mps: float
    rmse_deg: Mapping[str, float]


@dataclass(frozen=True)
class GpsSweep:
    """Filters by rising GPS noise on a test drive, and RMSE in deg of regressions without GPS."""

    scenario: str
    rate_hz: int
    levels: tuple[GpsLevel, ...]
    regressions: Mapping[str, float]

    def equal_at_mps(self, name: str, rmse_deg: float) -> float | None:
        """Return the noise at which a filter's RMSE reaches a value, interpolated; else None."""
        for low, high in pairwise(self.levels):
            below, above = low.rmse_deg[name], high.rmse_deg[name]
            if below <= rmse_deg <= above and below < above:
                share = (rmse_deg - below) / (above - below)
                return low.velocity_std_mps + share * (high.velocity_std_mps - low.velocity_std_mps)
        return None

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "scenario": self.scenario,
            "rate_hz": self.rate_hz,
            "draws": DRAWS,
            "levels": [asdict(level) for level in self.levels],
            "regressions": dict(self.regressions),
            "equal_at_mps": {
                name: {
                    regression: self.equal_at_mps(name, rmse_deg)
                    for regression, rmse_deg in self.regressions.items()
                }
                for name in self.levels[0].rmse_deg
            },
        }


def sweep_gps_noise(
    runs: Sequence[EvaluatedScenario],
    filters: Mapping[str, FilterEstimate],
    regressions: Sequence[str],
) -> GpsSweep | None:
    """Sweep the filters that use GPS on the nominal drive; None if it is not among the runs."""
    run = next((run for run in runs if run.scenario.name == SCENARIO), None)
    if run is None:
        return None
    levels = tuple(
        GpsLevel(std, {name: rmse_deg(run.drive, one, std) for name, one in filters.items()})
        for std in LEVELS_MPS
    )
    errors = {name: run.results[name].whole.rmse_deg for name in regressions}
    return GpsSweep(
        SCENARIO,
        run.scenario.sensors.gps.rate_hz,
        levels,
        {name: error for name, error in errors.items() if error is not None},
    )


def rmse_deg(drive: EvaluatedDrive, one: FilterEstimate, velocity_std_mps: float) -> float:
    """Return a filter's RMSE in deg over all draws; it believes as much more noise as there is."""
    stated = drive.scenario.sensors.gps.velocity_std_mps
    believed = {name: getattr(one.parameters, name) * velocity_std_mps / stated for name in STATED}
    told = replace(one, parameters=one.parameters.model_copy(update=believed)).in_drive(drive)
    generator = np.random.default_rng(SEED)
    squares = []
    for _ in range(DRAWS):
        estimate = told({**drive.signals, **drawn_gps(drive, velocity_std_mps, generator)})
        figures = error_figures(estimate, drive.sideslip_rad, drive.evaluated)
        squares.append(np.nan if figures.rmse_deg is None else figures.rmse_deg**2)
    return float(np.sqrt(np.mean(squares)))


def drawn_gps(
    drive: EvaluatedDrive, velocity_std_mps: float, generator: np.random.Generator
) -> dict[str, FloatArray]:
    """Return the true velocity with white noise at every fix, NaN between them."""
    every = SAMPLE_RATE_HZ // drive.scenario.sensors.gps.rate_hz
    fixes = np.arange(len(drive.time_s)) % every == 0
    noise = velocity_std_mps * generator.standard_normal((2, len(fixes)))
    return {
        "gps_vx_mps": np.where(fixes, drive.vx_mps + noise[0], np.nan),
        "gps_vy_mps": np.where(fixes, drive.vy_mps + noise[1], np.nan),
    }
