"""Draws how far the gates of a model are open on a test drive."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.evaluation.open_gates import gates_on
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario
from fleet_slip.comparison.report.time_series import Line, band, hide_time, shade
from fleet_slip.models.manifest import Manifest
from fleet_slip.pages.drawing import Size, colour


def opening(manifest: Manifest, run: EvaluatedScenario) -> Mapping[str, FloatArray]:
    """Return how far each gate is open on a test drive; see `gates_on`."""
    return gates_on(manifest, run.drive.signals, run.drive.facts)


ANGLE_IN = 2.0
GATE_IN = 0.75
HEAD_IN = 0.4
GAP_IN = 0.3
FOOT_IN = 0.45
LEFT_IN = 0.5
RIGHT_IN = 0.1


def angle_and_gates(
    run: EvaluatedScenario, line: Line, gates: Mapping[str, FloatArray], size: Size
) -> Figure:
    """Draw the true and the estimated angle, and beneath them how far each gate is open."""
    height = HEAD_IN + ANGLE_IN + len(gates) * (GAP_IN + GATE_IN) + FOOT_IN
    figure = Figure(figsize=(size.width_in, height))
    across = (LEFT_IN / size.width_in, 1 - (LEFT_IN + RIGHT_IN) / size.width_in)
    top = height - HEAD_IN
    time_s = run.drive.time_s
    panels = [figure.add_axes((across[0], (top - ANGLE_IN) / height, across[1], ANGLE_IN / height))]
    top -= ANGLE_IN
    for _ in gates:
        top -= GAP_IN + GATE_IN
        panels.append(figure.add_axes((across[0], top / height, across[1], GATE_IN / height)))
    for axes in panels:
        axes.set_xlim(time_s[0], time_s[-1])
        shade(axes, run, "unstable")
    angle, *strips = panels
    for tone, values in (
        ("truth", run.drive.sideslip_rad),
        (line.colour, run.estimates[line.estimator]),
    ):
        shown = band(time_s, np.where(run.drive.evaluated, np.degrees(values), np.nan), size.bins)
        angle.plot(shown.x, shown.mean, color=colour(tone), linewidth=1.1)
    angle.set_ylabel("deg", labelpad=2)
    angle.set_title(
        f"side-slip angle: true, and by {line.label} (in colour)", color=colour("muted")
    )
    for axes, (name, open_share) in zip(strips, gates.items(), strict=True):
        shown = band(time_s, open_share, size.bins)
        axes.fill_between(
            shown.x, 0, shown.mean, color=colour(line.colour), alpha=0.35, linewidth=0
        )
        axes.set_ylim(0, 1)
        axes.set_yticks([0, 1])
        axes.set_title(f"gate by {name}", color=colour("muted"))
    for axes in panels[:-1]:
        hide_time(axes)
    panels[-1].set_xlabel("time (s)", labelpad=2)
    return figure
