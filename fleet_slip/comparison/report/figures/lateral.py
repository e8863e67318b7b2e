"""Error by lateral acceleration: where the linear relation ends."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario
from fleet_slip.comparison.report.figures.labels import End, error_axes, finish_errors
from fleet_slip.comparison.report.figures.lines import smooth
from fleet_slip.comparison.report.figures.series import Line
from fleet_slip.pages.style import Size, colour
from fleet_slip.simulation.sensing.sensors import SAMPLE_RATE_HZ

BIN_MPS2 = 0.5
LEAST_ROWS = 200
SMOOTHED_S = 0.5
HEIGHT_IN = 3.3


def lateral_acceleration(run: EvaluatedScenario) -> FloatArray:
    """Return |ay| in m/s² at each tick: the sensor's, less its stated bias, smoothed."""
    ay = run.drive.signals["ay_mps2"] - run.drive.scenario.sensors.ay_bias_mps2
    return np.abs(smooth(ay, int(SMOOTHED_S * SAMPLE_RATE_HZ)))


def error_by_bin(
    runs: Sequence[EvaluatedScenario], estimator: str
) -> tuple[FloatArray, FloatArray]:
    """Return the middle of each bin in m/s² and the root mean square error in it, in deg."""
    acceleration = np.concatenate([lateral_acceleration(run) for run in runs])
    error = np.concatenate(
        [
            np.where(
                run.drive.evaluated,
                np.degrees(run.estimates[estimator] - run.drive.sideslip_rad),
                np.nan,
            )
            for run in runs
        ]
    )
    given = np.isfinite(error) & np.isfinite(acceleration)
    place = (acceleration[given] / BIN_MPS2).astype(int)
    rows = np.bincount(place)
    squares = np.bincount(place, weights=error[given] ** 2)
    kept = np.flatnonzero(rows >= LEAST_ROWS)
    middle = ((kept + 0.5) * BIN_MPS2).astype(np.float64)
    return middle, np.sqrt(squares[kept] / rows[kept]).astype(np.float64)


def error_by_acceleration(
    runs: Sequence[EvaluatedScenario], lines: Sequence[Line], trained_to_mps2: float, size: Size
) -> Figure:
    """Draw the error of each estimator over the lateral acceleration, on a logarithmic scale."""
    axes = error_axes(size, HEIGHT_IN, (1.35, 0.95))
    ends, furthest = [], 0.0
    for line in lines:
        middle, error = error_by_bin(runs, line.estimator)
        axes.plot(middle, error, color=colour(line.colour), linewidth=1.6, marker="o", markersize=3)
        furthest = max(furthest, float(middle[-1]))
        ends.append(End(float(error[-1]), line.label, line.colour))
    axes.axvspan(0, trained_to_mps2, color=colour("model_4"), alpha=0.07, linewidth=0)
    axes.text(
        trained_to_mps2,
        1.0,
        "training drives " if size.wide else "training ",
        transform=axes.get_xaxis_transform(),
        ha="right",
        va="top",
        color=colour("muted"),
        fontsize=8.5,
    )
    axes.set_xlim(0, furthest + BIN_MPS2 / 2)
    return finish_errors(axes, "size of the lateral acceleration (m/s²)", ends, size)
