"""The control chart of a model: its error on each day, with limits."""

from datetime import date
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from fleet_slip.errors import ConfigError
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.monitoring.monitor import Chart
from fleet_slip.pages.drawing import DESK, STYLE, Size, colour

HEIGHT_IN = 3.6
TONES = {"training": "muted", "new": "model_4", "beyond": "unstable"}


def control_chart(chart: Chart, size: Size) -> Figure:
    """Draw mean and standard deviation of the error over the days, in degrees."""
    figure = Figure(figsize=(size.width_in, HEIGHT_IN), layout="constrained")
    above, below = figure.subplots(2, sharex=True)
    panels = (
        (above, "mean", [day.error_mean_deg for day in chart.days], chart.mean_limits),
        (below, "std", [day.error_std_deg for day in chart.days], chart.std_limits),
    )
    for axes, name, values, limits in panels:
        groups: dict[str, list[tuple[date, float]]] = {}
        for day, value in zip(chart.days, values, strict=True):
            kind = "training" if day.training else "beyond" if name in day.alarms else "new"
            groups.setdefault(kind, []).append((day.day, value))
        for kind, points in groups.items():
            days, errors = zip(*points, strict=True)
            axes.plot(days, errors, "o", markersize=4, color=colour(TONES[kind]))
        axes.axhline(limits.centre, color=colour("muted"), linewidth=0.7)
        for limit in (limits.lower, limits.upper):
            if limit is not None:
                axes.axhline(limit, color=colour("unstable"), linewidth=0.8, linestyle="--")
        axes.set_title(f"{name} of the error, deg", color=colour("muted"))
    above.set_title(
        "training days grey, new days blue, beyond a limit red",
        color=colour("muted"),
        loc="right" if size.wide else "left",
        **({} if size.wide else {"y": 1.14}),
    )
    locator: Any = AutoDateLocator(minticks=2, maxticks=10 if size.wide else 5)  # type: ignore[no-untyped-call]
    below.xaxis.set_major_locator(locator)
    below.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    return figure


def save_chart(chart: Chart, file: Path) -> None:
    """Draw to a file, whose suffix says the format. Raises `ConfigError`, `StorageError`."""
    with mpl.rc_context(STYLE), storage_errors(file):
        figure = control_chart(chart, DESK)
        figure.suptitle(f"{chart.model}: error on each day", x=0.01, ha="left")
        try:
            # Without a date, the same chart is the same file.
            figure.savefig(file, metadata={"Date": None} if file.suffix == ".svg" else None)
        except ValueError as error:
            raise ConfigError(f"{file}: {error}") from None
