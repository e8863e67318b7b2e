"""What calls take that commands take too, said once: for `Fleet`, `FleetCohort` and commands.

A field with a `Doc` is an option of the command, too; the others are of Python alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typing_extensions import Doc

from fleet_slip.api.calls import ShowProgress, ShowStep, Workers
from fleet_slip.catalogue.facts import TRAINING_DRIVES
from fleet_slip.catalogue.features import PLAIN, features
from fleet_slip.errors import UsageError
from fleet_slip.grams.cohort import Cohort
from fleet_slip.grams.folding import FoldKey
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.request import CLUSTER, DEFAULT_MODELS, WHOLE_SET, WORTH, inputs_of
from fleet_slip.regression.drives import ClusterUnit

if TYPE_CHECKING:
    from fleet_slip.simulation.campaign import Campaign

Subject = Literal["vehicle", "drive", "drive_name", "source_file"]
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
class RunRequest:
    """What `Fleet.run` takes."""

    campaign: Annotated["str | Campaign", CAMPAIGN] = "waterford"
    _: KW_ONLY
    days: Annotated[int | None, DAYS] = None
    through: Annotated[date | str | None, THROUGH] = None
    name: Annotated[str | None, Doc("Name of the model. Default: the campaign's.")] = None
    models: Annotated[str, MODELS] = DEFAULT_MODELS
    worth: Annotated[str | None, WORTH] = None
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
    now: Annotated[bool, Doc("Delete the old files at once; compact would later.")] = False
    progress: ShowProgress | None = None

    @property
    def subject(self) -> tuple[Subject, str]:
        """What is to be forgotten, and its name. Raises `UsageError` unless one is given."""
        named: tuple[Subject, ...] = ("vehicle", "drive", "drive_name", "source_file")
        given = [(name, value) for name in named if (value := getattr(self, name)) is not None]
        if len(given) != 1:
            raise UsageError("give one of vehicle, drive, drive_name and source_file.")
        return given[0]


SIGNALS = Doc(
    "Instead of a published model: signals to fit, separated by commas; 'catalogue' is all inputs."
)


@dataclass(frozen=True)
class ExaminedRequest:
    """What is examined: a published model, or signals that are named."""

    model: Annotated[
        "str | ModelVersion | None",
        Doc(
            "NAME, NAME@VERSION or NAME@ALIAS of a published model. Default: the only one that "
            "there is, unless `signals` is given."
        ),
    ] = None
    _: KW_ONLY
    signals: Annotated[str | None, SIGNALS] = None
    features: Annotated[
        str | None, Doc("Feature set that `signals` are of. Default: the logged signals.")
    ] = None


@dataclass(frozen=True)
class DiagnosisRequest(ExaminedRequest):
    """What `FleetCohort.diagnose` takes."""

    _: KW_ONLY
    against: Annotated[
        str | None, Doc("Condition of another cohort: does it have the same coefficients?")
    ] = None
    cluster: Annotated[ClusterUnit | None, CLUSTER] = None


@dataclass(frozen=True)
class WhatIfRequest(ExaminedRequest):
    """What `FleetCohort.what_if` takes; both come on top of what the logs have."""

    _: KW_ONLY
    noise: Annotated[
        Mapping[str, float] | None,
        Doc(
            "Standard deviation of white noise that is added, in SI units, such as ay=0.2, once "
            "for each signal."
        ),
    ] = None
    bias: Annotated[
        Mapping[str, float] | None,
        Doc("Bias that is added, in SI units, such as yaw_rate=0.02, once for each signal."),
    ] = None


@dataclass(frozen=True)
class RegimesRequest:
    """What `FleetCohort.regimes` takes."""

    signals: Annotated[str | None, SIGNALS] = None
    _: KW_ONLY
    by: Annotated[FoldKey, Doc("What a fold is made of.")] = "drive"
    folds: Annotated[
        int | str | None,
        Doc(
            "Number of folds, or each: every drive, or whatever folds are made of, is a fold of "
            "its own. Default: 5."
        ),
    ] = None
    model: Annotated[
        "str | ModelVersion | None",
        Doc(
            "NAME, NAME@VERSION or NAME@ALIAS of a published model, whose signals are taken. "
            "Default: all signals, unless `signals` is given."
        ),
    ] = None
    over: Annotated[
        Sequence[str],
        Doc("Regimes to divide by, separated by commas, such as speed. Default: all of the set's."),
    ] = ()
    features: Annotated[
        str | None,
        Doc("Feature set that divides rows by regimes. Default: the first with the signals."),
    ] = None
    worth: Annotated[str | None, WORTH] = None


# What is examined: a published model, or signals that are named.


@dataclass(frozen=True)
class ExaminedModel:
    """The inputs of a published model, or named ones."""

    feature_set: str
    named: str | None
    version: ModelVersion | None

    @property
    def intercept(self) -> bool:
        """Whether the model has one; inputs that are named alone have."""
        return self.version is None or not self.version.manifest.through_origin

    def inputs(self, cohort: Cohort) -> tuple[str, ...]:
        """Return the inputs; all that the cohort has, if that was asked for."""
        if self.version is not None:
            return self.version.manifest.signals
        return inputs_of(cohort, self.named or WHOLE_SET)


def subject_of(registry: Registry, request: ExaminedRequest) -> ExaminedModel:
    """Return what is examined, by default the only model. Raises `UsageError` for both kinds."""
    model = request.model
    if request.signals is not None or request.features is not None:
        if model is not None:
            raise UsageError("name a published model or signals (of a feature set), not both.")
        return ExaminedModel(request.features or PLAIN, request.signals, None)
    if model is None:
        model = registry.only(", or signals")
    version = model if isinstance(model, ModelVersion) else registry.resolve(model)
    identity = version.manifest.trained_on.feature_set
    return ExaminedModel(features().name_of(identity), None, version)
