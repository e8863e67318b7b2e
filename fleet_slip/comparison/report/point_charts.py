"""Every estimator on every test drive."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from fleet_slip.comparison.report.error_charts import TICKS_DEG
from fleet_slip.pages.drawing import Size, colour

ROW_IN = 0.19
HEAD_IN = 0.5
FOOT_IN = 0.4
NAMES_IN = 1.6
RIGHT_IN = 0.15
OTHERS = "others"


@dataclass(frozen=True)
class Named:
    """An estimator that has a colour and a name of its own."""

    estimator: str
    label: str
    colour: str


def points_by_drive(
    errors: Mapping[str, Mapping[str, float]], named: Sequence[Named], size: Size
) -> Figure:
    """Draw RMSE in deg by drive and estimator, on a logarithmic axis; the nameless in grey."""
    height = HEAD_IN + len(errors) * ROW_IN + FOOT_IN
    figure = Figure(figsize=(size.width_in, height))
    axes = figure.add_axes(
        (
            NAMES_IN / size.width_in,
            FOOT_IN / height,
            1 - (NAMES_IN + RIGHT_IN) / size.width_in,
            len(errors) * ROW_IN / height,
        )
    )
    known = {one.estimator for one in named}
    rows = [(place, found) for place, found in enumerate(errors.values())]
    rest = [(rmse, p) for p, found in rows for n, rmse in found.items() if n not in known]
    if rest:
        axes.plot(*zip(*rest, strict=True), "|", color=colour("outage"), markersize=6, label=OTHERS)
    for one in reversed(named):
        own = [(found[one.estimator], p) for p, found in rows if one.estimator in found]
        if own:
            axes.plot(*zip(*own, strict=True), "o", color=colour(one.colour), markersize=4.5,
                      label=one.label)  # fmt: skip
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    ticks = TICKS_DEG if size.wide else (0.01, 0.1, 1, 10)
    shown = [tick for tick in ticks if low <= tick <= high]
    axes.set_xticks(shown, [f"{tick:g}°" for tick in shown])
    axes.minorticks_off()
    axes.grid(visible=True, axis="both")
    axes.set_yticks(range(len(errors)), list(errors), color=colour("ink"))
    axes.set_ylim(len(errors) - 0.5, -0.5)
    axes.set_xlabel("root mean square error", labelpad=2)
    marks, labels = axes.get_legend_handles_labels()
    figure.legend(
        marks[::-1], labels[::-1], loc="upper left", ncols=5 if size.wide else 2, frameon=False,
        fontsize=9 if size.wide else 7.5, handletextpad=0.2, columnspacing=1.2, borderaxespad=0.2,
    )  # fmt: skip
    return figure
