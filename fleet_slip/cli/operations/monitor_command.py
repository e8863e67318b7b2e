"""The command that charts a model's error by day: monitor."""

from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.cli.left_out import say_without_log
from fleet_slip.cli.model_argument import OnlyModel
from fleet_slip.cli.output import Json, print_json, print_table
from fleet_slip.dates import date_of
from fleet_slip.errors import AlarmError
from fleet_slip.extras import needed
from fleet_slip.monitoring.monitor import Chart


def monitor(
    context: typer.Context,
    model: OnlyModel = None,
    cohort: Annotated[
        str | None,
        typer.Option(
            help="SQL condition on the view drives. Default: the condition of its training."
        ),
    ] = None,
    since: Annotated[
        str | None,
        typer.Option(
            help="First new day, YYYY-MM-DD. Default: the one after the days it was trained on."
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Draw the chart to an SVG, PDF or PNG file.")
    ] = None,
    json: Json = False,
) -> None:
    """Chart a model's error on each day since it was trained, with control limits.

    Reads Gram rows only. Exit code 10 if a new day is beyond the limits.

    Example: **fleet-slip monitor waterford --since 2024-05-03**
    """
    chart: Chart = context.obj.monitor(model, cohort, since=date_of(since, "--since"))
    if plot:
        with needed("report", "a chart"):
            from fleet_slip.monitoring.control_chart import save_chart  # noqa: PLC0415
        save_chart(chart, plot)
    if json:
        print_json(chart)
    else:
        _print_chart(chart)
        say_without_log(chart.drives_left_out, chart.feature_set)
    if chart.alarms:
        days = ", ".join(f"{day.day} ({' and '.join(day.alarms)})" for day in chart.alarms)
        raise AlarmError(f"the error of {chart.model} is beyond its limits on {days}")


def _print_chart(chart: Chart) -> None:
    mean, std = chart.mean_limits, chart.std_limits
    print_table(
        f"{chart.model}, drives where {chart.cohort}; limits from the training days: "
        f"mean {mean.lower:+.4f} to {mean.upper:+.4f}, std up to {std.upper:.4f} deg",
        ["day", "", "drives", "rows", "RMSE deg", "mean deg", "std deg"],
        [
            [
                str(day.day),
                "training" if day.training else "new, alarm" if day.alarms else "new",
                f"{day.drives:,}",
                f"{day.rows:,}",
                f"{day.rmse_deg:.4f}",
                f"{day.error_mean_deg:+.4f}" + ("*" if "mean" in day.alarms else ""),
                f"{day.error_std_deg:.4f}" + ("*" if "std" in day.alarms else ""),
            ]
            for day in chart.days
        ],
        left=2,
    )
