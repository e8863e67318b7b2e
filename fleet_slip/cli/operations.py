"""The command that tells the health of the warehouse: status."""

import logging
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from statistics import median, pstdev
from typing import TYPE_CHECKING, Annotated

import typer

from fleet_slip.api.fleet import Fleet
from fleet_slip.base import date_of, needed, number_of
from fleet_slip.catalogue.facts import CAR_NUMBERS, NumberName
from fleet_slip.cli.options import command
from fleet_slip.cli.output import (
    Json,
    print_json,
    print_records,
    print_table,
    print_text,
    say,
)
from fleet_slip.cli.selection import say_without_log
from fleet_slip.errors import AlarmError, UsageError
from fleet_slip.grams.calibration import SURE_ERRORS, Calibration, ChangedNumber
from fleet_slip.grams.car_evidence import FEWEST_CARS, CalibratedNumber, Roads
from fleet_slip.operations.status import WarehouseStatus

if TYPE_CHECKING:
    from fleet_slip.operations.monitor import Chart
    from fleet_slip.operations.night import NightReport
    from fleet_slip.operations.quality import QualityReport


@command(Fleet.status)
def status(
    found: WarehouseStatus,
    prometheus: Annotated[
        bool,
        typer.Option("--prometheus", help="Print metrics, for the textfile collector of a node."),
    ] = False,
    json: Json = False,
) -> None:
    """Tell the warehouse's health: freshness, backlog, last runs, disk, champions.

    Exit code 10 if something calls for attention.

    Example: **fleet-slip status --max-age-hours 26**
    """
    if json and prometheus:
        raise UsageError("give one of --json and --prometheus.")
    if prometheus:
        from fleet_slip.operations.status import as_openmetrics  # noqa: PLC0415 - seldom asked

        print_text(as_openmetrics(found).removesuffix("\n"))
    elif json:
        print_json(found)
    else:
        _print_status(found)
    for problem in found.problems:
        say(f"- {problem}", logging.ERROR)
    if found.problems:
        raise AlarmError(f"{number_of(len(found.problems), 'matter')}, above, to be looked after.")


def _print_status(found: WarehouseStatus) -> None:
    print_records(
        f"{found.root} at {found.checked_at:%Y-%m-%d %H:%M} UTC",
        "table|last commit|version|files|rows|size MB",
        "{name}|{committed_at:%Y-%m-%d %H:%M}|{version}|{files:,}|{rows:,}|{size_mb:,.1f}",
        (
            {"name": name, "size_mb": one.size_bytes / 1e6, **vars(one)}
            for name, one in found.tables.items()
        ),
        left=2,
    )
    backlog = f"{number_of(found.backlog_files, 'file')}, {number_of(found.backlog_rows, 'row')}"
    facts = {"newest day": str(found.newest_day or "none"), "waiting for the Gram job": backlog}
    if found.disk_free_bytes is not None and found.disk_free_fraction is not None:
        free = f"{found.disk_free_bytes / 1e9:,.1f} GB free, {found.disk_free_fraction:.0%}"
        facts["disk"] = free
    print_table("", ["", ""], facts.items(), left=2)
    if found.last_runs:
        header = "command|started|state|seconds|rows"
        row = "{command}|{started_at:%Y-%m-%d %H:%M:%S}|{state}|{seconds:.1f}|{rows:,}"
        print_records("\nlast runs", header, row, found.last_runs, left=3)
    if found.champions:
        header = "model|published|age h|logs behind|grams behind"
        row = (
            "{model}@{version}|{published_at:%Y-%m-%d %H:%M}|{age_hours:,.1f}|"
            "{logs_behind}|{grams_behind}"
        )
        print_records("\nchampions", header, row, found.champions, left=2)


# How the sensors of cars are off: the command calibrate.


@command(Fleet.calibrate)
def calibrate(
    found: Calibration,
    car: Annotated[
        str | None,
        typer.Option(help="Show this car's numbers, and how they go on board.", show_default=False),
    ] = None,
    since: Annotated[
        str | None,
        typer.Option(
            help="Show instead what has changed in cars from this day on, such as 2024-06-15.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Tell from each car's own drives how its sensors are off: no label, no log row is read.

    Offsets of gyroscope, accelerometer and steering, tyre radius, steering and understeer, each
    with its uncertainty and how fast it shrinks with drives. Needs the Gram rows of: **fleet-slip
    gram --features calibration**. SQL sees the same: **fleet-slip sql "FROM calibration"**

    Example: **fleet-slip calibrate**
    """
    day = date_of(since, "--since")
    if car is not None:
        found.car(car)  # that there is such a car
    changed = [one for one in found.changed(day) if car in (None, one.car)] if day else []
    if json:
        shown = found.as_dict()
        if day:
            shown["changed"] = [vars(one) for one in changed]
        if car is not None:
            shown["cars"] = {car: shown["cars"][car]}
        print_json(shown)
    elif day:
        _print_changed(changed, day)
    elif car is not None:
        _print_car(car, found.car(car), found.evidence.refusals(car))
        _say_of_roads(found.roads)
    else:
        _print_fleet(found)
        _say_of_roads(found.roads)


def _print_car(
    car: str,
    numbers: Mapping[NumberName, CalibratedNumber],
    refusals: Mapping[NumberName, str],
) -> None:
    print_records(
        f"{car}, by its own drives",
        "number|unit|value|+-|drives|count on board|of",
        "{name}|{of.unit}|{one.value:.6g}|{one.uncertainty:.2g}|{one.drives}|{one.count}|{of.grain}",
        ({"name": name, "of": CAR_NUMBERS[name], "one": one} for name, one in numbers.items()),
        left=2,
    )
    for reason in dict.fromkeys(refusals.values()):
        names = [name for name, why in refusals.items() if why == reason]
        say(f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} missing: {reason}")


def _print_fleet(found: Calibration) -> None:
    rows = []
    for name, about in CAR_NUMBERS.items():
        cars = [numbers[name] for numbers in found.cars.values() if name in numbers]
        known = [one.uncertainty for one in cars if one.uncertainty is not None]
        if cars:
            row = {"name": name, "unit": about.unit, "cars": len(cars)}
            values = [one.value for one in cars]
            row |= {"median": median(values), "spread": pstdev(values)}
            rows.append(row | {"known": median(known) if known else None})
    print_records(
        f"{number_of(len(found.cars), 'car')}, by their own drives",
        "number|unit|cars|median|differs by|known to +-",
        "{name}|{unit}|{cars:,}|{median:.3g}|{spread:.2g}|{known:.2g}",
        rows,
        left=2,
    )
    if not any(one.uncertainty for cars in found.cars.values() for one in cars.values()):
        say("no car has two drives: how sure the numbers are cannot be told")


def _print_changed(changed: Sequence[ChangedNumber], since: date) -> None:
    if not changed:
        return say(f"no number of a car is another since {since}, as far as its drives tell")
    header = "car|number|unit|before|after|+-"
    row = "{car}|{number}|{unit}|{before:.5g}|{after:.5g}|{uncertainty:.2g}"
    rows = ({**vars(one), "unit": CAR_NUMBERS[one.number].unit} for one in changed)
    title = f"changed since {since}, by more than {SURE_ERRORS:g} standard errors"
    print_records(title, header, row, rows, left=3)


def _say_of_roads(roads: Roads) -> None:
    if roads.hide_offsets:
        say(
            "bends look banked, and roads may always lean to one side, which fewer than "
            f"{FEWEST_CARS} cars with offsets cannot tell from their own: no car has ay_offset"
        )
    elif not roads.banked:
        say(
            "bends are seen not to be banked: a road that always leans to one side counts as "
            f"ay_offset. {FEWEST_CARS} cars or more tell the one from the other"
        )


# The command that charts a model's error by day: monitor.


@command(Fleet.monitor, arguments=["model"])
def monitor(
    chart: "Chart",
    plot: Annotated[
        Path | None, typer.Option(help="Draw the chart to an SVG, PDF or PNG file.")
    ] = None,
    json: Json = False,
) -> None:
    """Chart a model's error on each day since it was trained, with control limits.

    Reads Gram rows only. Exit code 10 if a new day is beyond the limits.

    Example: **fleet-slip monitor waterford --since 2024-05-03**
    """
    if plot:
        with needed("report", "a chart"):
            from fleet_slip.operations.monitor import save_chart  # noqa: PLC0415
        save_chart(chart, plot)
    if json:
        print_json(chart)
    else:
        _print_chart(chart)
        say_without_log(chart.drives_left_out, chart.feature_set)
    if chart.alarms:
        days = ", ".join(f"{day.day} ({' and '.join(day.alarms)})" for day in chart.alarms)
        raise AlarmError(f"the error of {chart.model} is beyond its limits on {days}")


def _print_chart(chart: "Chart") -> None:
    mean, std = chart.mean_limits, chart.std_limits
    print_records(
        f"{chart.model}, drives where {chart.cohort}; limits from the training days: "
        f"mean {mean.lower:+.4f} to {mean.upper:+.4f}, std up to {std.upper:.4f} deg",
        "day||drives|rows|RMSE deg|mean deg|std deg|beyond",
        "{day}|{kind}|{drives:,}|{rows:,}|{rmse_deg:.4f}|{error_mean_deg:+.4f}|{error_std_deg:.4f}|"
        "{alarms}",
        ({**vars(one), "kind": "training" if one.training else "new"} for one in chart.days),
        left=2,
    )


# The command of every night with real cars.


@command(Fleet.nightly, progress=("", "rows"), name="--model")
def nightly(
    report: "NightReport",
    output: Annotated[
        Path | None,
        typer.Option(
            help="Write the summary there: NIGHT.txt, NIGHT.json, NIGHT.html. It names drives; "
            "forget does not reach it.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Do all of a night with real cars: ingest what is new, examine it, train again, verify.

    Drives with faulty sensors train no model. The winner becomes champion if it is not worse, else
    a candidate. Killed at any moment and given again, it ends where it would have ended. Exits with
    10 if something calls for attention, else with the code of the first step that failed.

    Example: **fleet-slip nightly --landing /srv/logs --mapping logger.toml --model fleet**
    """
    if output is not None:
        with needed("report", "a summary in files"):
            from fleet_slip.operations.night import write_summary  # noqa: PLC0415 - draws

        write_summary(report, output)
    if json:
        print_json(report)
    else:
        print_text(report.as_text())
    if problem := report.problem:
        problem.headline = f"the night of {report.night}: {report.verdict}"
        raise problem


# The command that finds faulty sensors: quality.


@command(Fleet.quality)
def quality(found: "QualityReport", json: Json = False) -> None:
    """Find stuck, saturated, biased, noisy, scaled, reversed and swapped sensors, drive by drive.

    Reads Gram rows only. Exit code 10 if a drive's sensors are not in order.

    Example: **fleet-slip quality --cohort "day >= '2024-05-02'"**
    """
    peers = "other" if found.compared else "too few"
    examined = (
        f"{number_of(found.drives, 'drive')} examined, {found.compared:,} of them beside their "
        f"peers ({peers} drives of a car or vehicle model)"
    )
    if json:
        print_json(found)
    elif found.findings:
        header = "drive|car|fault|signals|what shows it"
        row = "{drive_id}|{vehicle_id}|{fault.kind}|{fault.signals}|{fault.figure}"
        print_records(examined, header, row, found.findings, left=5)
    else:
        print_text(f"{examined}: {'all are in order' if found.drives else 'none is long enough'}")
    if found.findings:
        raise AlarmError(
            f"{len(found.findings)} of {number_of(found.drives, 'drive')} are not in order"
        )
