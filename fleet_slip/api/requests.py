"""What a run, a night and forgetting take, said once: for the methods of `Fleet` and for commands.

A field with a `Doc` is an option of the command, too; the others are of Python alone.
"""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typing_extensions import Doc

from fleet_slip.api.calls import ShowProgress, ShowStep, Workers
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import UsageError
from fleet_slip.selection.request import DEFAULT_MODELS, WORTH

if TYPE_CHECKING:
    from fleet_slip.simulation.campaign import Campaign

Subject = Literal["vehicle", "drive", "drive_name", "source_file"]
MODELS = Doc("A model list of configs/models, or a TOML file.")


@dataclass(frozen=True)
class RunRequest:
    """What `Fleet.run` takes."""

    campaign: Annotated[
        "str | Campaign", Doc("A campaign of configs/campaigns, or the path of a TOML file.")
    ] = "waterford"
    _: KW_ONLY
    days: Annotated[int | None, Doc("Simulate the first N days only. Default: all.")] = None
    through: Annotated[
        date | str | None, Doc("Last day to simulate, YYYY-MM-DD or today. Default: all days.")
    ] = None
    name: Annotated[str | None, Doc("Name of the model. Default: the campaign's.")] = None
    models: Annotated[str, MODELS] = DEFAULT_MODELS
    worth: Annotated[str | None, WORTH] = None
    sign_key: Path | None = None
    workers: Workers = None
    progress: ShowStep | None = None
    waiting: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class NightRequest:
    """What `Fleet.nightly` takes."""

    landing: Annotated[
        Path | str, Doc("The folder where logs land, or s3://…; what is new in it is taken.")
    ]
    mapping: Annotated[
        str,
        Doc("A mapping or a list of them: of configs/mappings, or a TOML file."),
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
    sign_key: Path | None = None
    workers: Workers = None
    progress: ShowStep | None = None
    waiting: Callable[[], None] = lambda: None


@dataclass(frozen=True, kw_only=True)
class ForgetRequest:
    """What `Fleet.forget` takes."""

    vehicle: Annotated[str | None, Doc("The vehicle_id to forget.")] = None
    drive: Annotated[str | None, Doc("The drive_id to forget.")] = None
    drive_name: Annotated[str | None, Doc("The drive_name whose drives are to be forgotten.")] = (
        None
    )
    source_file: Annotated[str | None, Doc("The source_file whose drives are to be forgotten.")] = (
        None
    )
    now: Annotated[bool, Doc("Delete the old files at once, not when vacuum is due.")] = False
    progress: ShowProgress | None = None

    @property
    def subject(self) -> tuple[Subject, str]:
        """What is to be forgotten, and its name. Raises `UsageError` unless one is given."""
        named: tuple[Subject, ...] = ("vehicle", "drive", "drive_name", "source_file")
        given = [(name, value) for name in named if (value := getattr(self, name)) is not None]
        if len(given) != 1:
            raise UsageError("give one of vehicle, drive, drive_name and source_file.")
        return given[0]
