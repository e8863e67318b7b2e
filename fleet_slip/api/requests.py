"""What calls take that commands take too, said once: for `Fleet`, `FleetCohort` and commands.

A field with a `Doc` is an option of the command, too; the others are of Python alone.
"""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typing_extensions import Doc

from fleet_slip.api.calls import ShowStep, Workers
from fleet_slip.catalogue.facts import TRAINING_DRIVES
from fleet_slip.models.request import DEFAULT_MODELS, WORTH

if TYPE_CHECKING:
    pass

COHORT = Doc("SQL condition on the view drives, such as \"track = 'waterford_hills'\".")
UNEXAMINED = Doc(
    "Take drives whose sensors are not in order, too. As a rule all are examined first."
)
MODEL = Doc(
    "NAME, NAME@VERSION or NAME@ALIAS of a published model; NAME alone is its champion. Default: "
    "the only one that there is."
)
VERSION = Doc("NAME, NAME@VERSION or NAME@ALIAS. NAME alone is its champion.")
ALIAS = Doc("The alias to move.")
CAMPAIGN = Doc("A campaign of configs/campaigns, or the path of a TOML file.")
DAYS = Doc("Simulate the first N days only. Default: all.")
THROUGH = Doc("Last day to simulate, YYYY-MM-DD or today. Default: all days.")
MODELS = Doc("A model list of configs/models, or a TOML file.")


@dataclass(frozen=True)
class NightRequest:
    """What `Fleet.nightly` takes."""

    landing: Annotated[
        Path | str, Doc("The folder where logs land, or s3://…; what is new in it is taken.")
    ]
    mapping: Annotated[
        str,
        Doc("A mapping: of configs/mappings, or a TOML file."),
    ]
    name: Annotated[str, Doc("Name of the model.")]
    _: KW_ONLY
    cohort: Annotated[str, Doc("SQL condition on the view drives: which drives train it.")] = (
        TRAINING_DRIVES
    )
    models: Annotated[str, MODELS] = DEFAULT_MODELS
    worth: Annotated[str | None, WORTH] = None
    candidate: Annotated[bool, Doc("Publish as a candidate, even what is not worse.")] = False
    retention: Annotated[
        str | None, Doc("A retention file. Default: retention.toml of the configs.")
    ] = None
    night: Annotated[date | str | None, Doc("Date of the night, YYYY-MM-DD. Default: today.")] = (
        None
    )
    workers: Workers = None
    progress: ShowStep | None = None
    waiting: Callable[[], None] = lambda: None
