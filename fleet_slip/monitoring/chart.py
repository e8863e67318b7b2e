"""Draws a control chart."""

from datetime import date
from pathlib import Path
from typing import Any

from fleet_slip.errors import ConfigError
from fleet_slip.extras import needed
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.monitoring.monitor import Chart, Limits

TRAINING = ("training, predicted without the day", "0.55")
NEW = ("new", "tab:blue")
BEYOND = ("beyond the limits", "tab:red")


def draw(chart: Chart, file: Path) -> None:
    """Draw mean and standard deviation of the error over the days, with their limits.

    The suffix of the file says the format. Raises `ConfigError` for an unknown suffix,
    `ExtraError` without matplotlib, and `StorageError` if the file cannot be written.
    """
    with needed("report", "a chart"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
        from matplotlib.figure import Figure  # noqa: PLC0415
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, sharex=True)
    above.set_title(f"{chart.model}: error on each day", loc="left")
    means = [day.error_mean_deg for day in chart.days]
    stds = [day.error_std_deg for day in chart.days]
    _panel(above, chart, means, chart.mean_limits, "mean")
    _panel(below, chart, stds, chart.std_limits, "std")
    below.legend(loc="upper left", frameon=False, ncols=3)
    below.tick_params(axis="x", rotation=30)
    with storage_errors(file):
        try:
            # Without a date, the same chart is the same file.
            figure.savefig(file, metadata={"Date": None} if file.suffix == ".svg" else None)
        except ValueError as error:
            raise ConfigError(f"{file}: {error}") from None


def _panel(axes: Any, chart: Chart, values: list[float], limits: Limits, name: str) -> None:
    groups: dict[tuple[str, str], list[tuple[date, float]]] = {}
    for day, value in zip(chart.days, values, strict=True):
        style = TRAINING if day.training else BEYOND if name in day.alarms else NEW
        groups.setdefault(style, []).append((day.day, value))
    for (label, colour), points in groups.items():
        axes.plot(*zip(*points, strict=True), "o", color=colour, label=label)
    axes.axhline(limits.centre, color="0.3", linewidth=1)
    for limit in (limits.lower, limits.upper):
        if limit is not None:
            axes.axhline(limit, color="tab:red", linewidth=1, linestyle="--")
    axes.set_ylabel(f"{name} of the error, deg")
    axes.spines[["top", "right"]].set_visible(False)
