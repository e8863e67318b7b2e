"""The command that finds faulty sensors: quality."""

from typing import Annotated

import typer

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.output import Json, print_json, print_table, print_text
from fleet_slip.errors import AlarmError
from fleet_slip.monitoring.quality import QualityReport
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
    if found.findings:
        raise AlarmError(
            f"{len(found.findings)} of {number_of(found.drives, 'drive')} are not in order"
        )


def _print_quality(found: QualityReport) -> None:
    examined = (
        f"{number_of(found.drives, 'drive')} examined, {found.compared:,} of them beside their "
        f"peers ({'other' if found.compared else 'too few'} drives of a car or vehicle model)"
    )
    if not found.findings:
        order = "all are in order" if found.drives else "none is long enough"
        print_text(f"{examined}: {order}")
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
