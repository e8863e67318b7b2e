"""The summary of a night as files: text, JSON, and one static page."""

import json
from pathlib import Path

from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.monitoring.control_chart import control_chart
from fleet_slip.monitoring.monitor import Chart
from fleet_slip.monitoring.night_report import NightReport
from fleet_slip.pages.drawing import Picture, draw
from fleet_slip.pages.page_parts import Cell, Mark, ReportTable, Tile, count, fill_in, table
from fleet_slip.words import number_of

MARKS: dict[str, Mark] = {"done": "good", "attention": "miss", "failed": "miss", "left out": ""}


def write_summary(report: NightReport, folder: Path) -> list[Path]:
    """Write NIGHT.txt, .json and .html, each as a whole; return them. Raises `StorageError`."""
    files = {
        f"{report.night}.txt": report.as_text() + "\n",
        f"{report.night}.json": json.dumps(report.as_dict(), indent=2, default=str) + "\n",
        f"{report.night}.html": render_night(report),
    }
    place = LocalFolder(folder)
    for name, text in files.items():
        place.put(name, text.encode("utf-8", "backslashreplace"))
    return [folder / name for name in files]


def render_night(report: NightReport) -> str:
    """Return the page of a night."""
    drawn = None if report.chart is None else draw(_picture(report.chart))
    return fill_in(
        "night.html.j2",
        night=report,
        tiles=_tiles(report),
        steps=_steps(report),
        faults=_faults(report),
        drawn=drawn,
        past=_past(report),
    )


def _tiles(report: NightReport) -> list[Tile]:
    before = report.before.champion
    was = f", was {before}" if before not in (None, report.champion) else ""
    tiles = [
        Tile(f"{report.exit_code}", "exit code"),
        Tile(f"{report.drives:,}", f"drives, {count(report.rows)} rows"),
        Tile(report.champion or "none", f"champion{was}"),
        Tile(f"{len(report.new_faults)}", f"newly faulty drives, {len(report.faults)} in all"),
    ]
    if report.candidate not in (None, report.champion):
        tiles.append(Tile(report.candidate or "", "candidate, waits for fleet-slip promote"))
    return tiles


def _steps(report: NightReport) -> ReportTable:
    rows: list[list[str | Cell]] = [
        [one.name, Cell(one.state, MARKS[one.state]), one.told, f"{one.seconds:.1f}"]
        for one in report.steps
    ]
    return table(
        "night-steps",
        "What was done",
        ["step", "state", "what came of it", "seconds"],
        rows,
        left=3,
    )


def _faults(report: NightReport) -> ReportTable | None:
    if not report.new_faults:
        return None
    rows: list[list[str | Cell]] = [
        [
            one.drive_id,
            one.vehicle_id,
            one.fault.kind,
            " ".join(one.fault.signals),
            one.fault.figure,
        ]
        for one in report.new_faults
    ]
    head = ["drive", "car", "fault", "signals", "what shows it"]
    return table("night-faults", "Sensors not in order since this night", head, rows, left=5)


def _past(report: NightReport) -> ReportTable | None:
    if not report.past:
        return None
    rows: list[list[str | Cell]] = []
    for one, earlier in zip(report.past, [*report.past[1:], None], strict=True):
        found = [f"{name} {state}" for name, state in one.steps.items() if MARKS[state] == "miss"]
        more = "" if earlier is None else f"{one.drives - earlier.drives:+,}"
        told = Cell("; ".join(found) or "all went well", "miss" if found else "good")
        rows.append([str(one.night), told, str(one.exit_code), more, one.champion or "none"])
    head = ["night", "how it went", "exit code", "drives", "champion"]
    return table("nights", f"The last {number_of(len(rows), 'night')}", head, rows, left=2)


def _picture(chart: Chart) -> Picture:
    new = [day for day in chart.days if not day.training]
    title = f"{chart.model}: error on each day"
    caption = (
        f"Mean and standard deviation of the error on {number_of(len(chart.days), 'day')}, "
        f"{len(new)} of them new; dashed: the limits that the training days set. "
        f"Beyond a limit: {number_of(len(chart.alarms), 'day')}."
    )
    return Picture(
        "control-chart",
        title,
        caption,
        "Points over the days, beside their limits.",
        lambda size: control_chart(chart, size),
    )
