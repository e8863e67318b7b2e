"""The command that identifies a car from labelled drives: identify."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.options import Cohort
from fleet_slip.cli.output import Json, print_json, print_table, say
from fleet_slip.cli.workers import Threads
from fleet_slip.files.storage_errors import storage_errors
from fleet_slip.words import number_of

if TYPE_CHECKING:
    from fleet_slip.comparison.observers.identification import Identified


def identify(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="What the car is to be called.")],
    mass: Annotated[float, typer.Option(help="Of the whole car, kg.", min=1)],
    front_axle: Annotated[
        float, typer.Option(help="From the centre of gravity to the front axle, m.", min=0.01)
    ],
    rear_axle: Annotated[float, typer.Option(help="To the rear axle, m.", min=0.01)],
    track: Annotated[float, typer.Option(help="m.", min=0.01)] = 1.55,
    height: Annotated[
        float, typer.Option(help="Of the centre of gravity above the road, m.", min=0.01)
    ] = 0.55,
    radius: Annotated[float, typer.Option(help="Rolling radius, m.", min=0.01)] = 0.315,
    front_drive: Annotated[
        float, typer.Option(help="Share of the drive torque in front.", min=0, max=1)
    ] = 1.0,
    cohort: Cohort = TRAINING_DRIVES,
    output: Annotated[
        Path | None, typer.Option(help="Write the vehicle file here.", show_default=False)
    ] = None,
    threads: Threads = None,
    json: Json = False,
) -> None:
    """Identify a car's tyres and inertia from labelled drives, as a vehicle file for filters.

    Given what scales and a tape measure say, an extended Kalman filter in the car is fitted to the
    label. Its error on drives that were left out stands beside it.

    Example: **fleet-slip identify hatchback --mass 1776 --front-axle 1.19 --rear-axle 1.44**
    """
    found: Identified = context.obj.cohort(cohort).identify(
        name,
        mass_kg=mass,
        front_axle_m=front_axle,
        rear_axle_m=rear_axle,
        track_m=track,
        height_m=height,
        rolling_radius_m=radius,
        front_drive_share=front_drive,
        threads=threads,
    )
    if output is not None:
        with storage_errors(output):
            output.write_text(found.as_toml(), encoding="utf-8")
    if json:
        print_json(found.as_dict())
        return
    shown = found.as_dict()
    print_table(
        f"{name}, identified from {number_of(found.drives, 'drive')}",
        ["what", "value"],
        [[what.replace("_", " "), f"{value:.4g}"] for what, value in shown["found"].items()],
    )
    held_out = shown["held_out_deg"]
    say(
        f"the extended Kalman filter in it errs by {shown['fit_deg']:.4f} deg on these drives"
        + ("." if held_out is None else f", and by {held_out:.4f} deg on those left out.")
    )
    if output is not None:
        say(f"written to {output}: a vehicle file, as in configs/vehicles.")
