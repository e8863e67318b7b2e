"""The speed driven, over time."""

from matplotlib.figure import Figure

from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive
from fleet_slip.comparison.report.figures.lines import band
from fleet_slip.pages.style import Size, colour

HEIGHT_IN = 2.0
KMH_PER_MPS = 3.6


def speed(drive: EvaluatedDrive, size: Size) -> Figure:
    """Draw the true speed of a drive."""
    figure = Figure(figsize=(size.width_in, HEIGHT_IN))
    axes = figure.add_axes(
        (0.42 / size.width_in, 0.42 / HEIGHT_IN, 1 - 0.5 / size.width_in, 1.32 / HEIGHT_IN)
    )
    kmh = drive.speed_mps * KMH_PER_MPS
    series = band(drive.time_s, kmh, size.bins)
    axes.plot(series.x, series.mean, color=colour("model_4"), linewidth=1.3)
    axes.set_xlim(drive.time_s[0], drive.time_s[-1])
    axes.set_ylim(0, 1.05 * float(kmh.max()))
    axes.set_xlabel("time (s)", labelpad=2)
    axes.set_title("speed (km/h)", color=colour("muted"))
    return figure
