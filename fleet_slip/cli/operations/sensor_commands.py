"""Commands that watch sensors and models, and follow the catalogue: quality, monitor, migrate."""

from datetime import date
from pathlib import Path
from typing import Annotated

import typer

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.begin.run_command import DEFAULT_CAMPAIGN
from fleet_slip.cli.left_out import say_revoked, say_untold, say_without_log
from fleet_slip.cli.models.version_commands import Reference
from fleet_slip.cli.output import Json, print_json, print_table, say
from fleet_slip.cli.progress_bar import progress
from fleet_slip.cli.recorded import record_run
from fleet_slip.errors import AlarmError, UsageError
from fleet_slip.monitoring.monitor import Chart
from fleet_slip.monitoring.quality import QualityReport
from fleet_slip.warehouse.minimum_cohort import tells_single_cars
from fleet_slip.words import number_of


def quality(
    context: typer.Context,
    cohort: Annotated[
        str,
        typer.Option(help="SQL condition on the view drives: which drives to examine together."),
    ] = TRAINING_DRIVES,
    json: Json = False,
) -> None:
    """Find stuck, saturated, biased, noisy, scaled, reversed and swapped sensors, drive by drive.

    Reads Gram rows only. Exit code 10 if a drive's sensors are not in order.

    Example: **fleet-slip quality --cohort "day >= '2024-05-02'"**
    """
    found: QualityReport = context.obj.quality(cohort)
    if json:
        print_json(found)
    else:
        _print_quality(found)
        say_revoked(found.revoked)
    if found.findings:
        raise AlarmError(
            f"{len(found.findings)} of {number_of(found.drives, 'drive')} are not in order"
        )


def _print_quality(found: QualityReport) -> None:
    examined = (
        f"{number_of(found.drives, 'drive')} examined, {found.compared:,} of them beside their "
        "peers"
    )
    if not found.findings:
        order = "all are in order" if found.drives else "none is long enough"
        typer.echo(f"{examined}: {order}")
        return
    if not tells_single_cars():
        rows = [[kind, signals, f"{many:,}"] for (kind, signals), many in found.by_fault().items()]
        print_table(examined, ["fault", "signals", "drives"], rows, left=2)
        return
    print_table(
        examined,
        ["drive", "car", "fault", "signals", "what shows it"],
        [
            [
                finding.drive_id,
                finding.vehicle_id,
                finding.fault.kind,
                " ".join(finding.fault.signals),
                finding.fault.figure,
            ]
            for finding in found.findings
        ],
        left=5,
    )


def monitor(
    context: typer.Context,
    reference: Reference = DEFAULT_CAMPAIGN,
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
    chart: Chart = context.obj.monitor(reference, cohort, since=_first_new_day(since))
    if plot:
        from fleet_slip.monitoring.chart import draw  # noqa: PLC0415 - an optional dependency

        draw(chart, plot)
    if json:
        print_json(chart)
    else:
        _print_chart(chart)
        say_without_log(chart.drives_left_out, chart.feature_set)
        say_revoked(chart.drives_revoked)
        say_untold(chart.days_untold, "day")
    if chart.alarms:
        days = ", ".join(f"{day.day} ({' and '.join(day.alarms)})" for day in chart.alarms)
        raise AlarmError(f"the error of {chart.model} is beyond its limits on {days}")


def _first_new_day(text: str | None) -> date | None:
    try:
        return None if text is None else date.fromisoformat(text)
    except ValueError:
        raise UsageError(f"--since {text}: not a date; write it as 2024-05-01.") from None


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


@record_run
def migrate(context: typer.Context, json: Json = False) -> None:
    """Bring the logs to the signal catalogue: add columns, convert counts to other scales.

    See docs/schema.md before widening a scale. It can be repeated after any interruption.

    Example: **fleet-slip migrate**
    """
    with progress("migrate", "rows") as show:
        report = context.obj.migrate(progress=show)
    if json:
        print_json(report)
        return
    if not report.changed:
        say("migrate: nothing to do, the logs agree with the signal catalogue")
    if report.added:
        say(f"added: {', '.join(report.added)}; null in the files that are there")
    for name, (old, new) in report.rescaled.items():
        say(f"{name}: counts of {old} are now counts of {new}")
    if report.files_without_names:
        files = number_of(report.files_without_names, "file")
        say(f"{files} written anew, without names that none of their rows has")
    if report.files_rewritten:
        say(
            f"{number_of(report.files_rewritten, 'file')}, "
            f"{number_of(report.rows_rewritten, 'row')} rewritten. Run: "
            "fleet-slip gram"
        )
