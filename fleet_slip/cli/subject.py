"""What a command examines: a published model, or signals that are named."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import typer

from fleet_slip.catalogue.features import PLAIN, features
from fleet_slip.cli.models import registry_of
from fleet_slip.errors import ConfigError, QuestionError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.versions import Registry
from fleet_slip.selection.request import WHOLE_SET, inputs_of
from fleet_slip.warehouse.tables import Warehouse

Model = Annotated[
    str | None,
    typer.Argument(
        help="NAME, NAME@VERSION or NAME@ALIAS of a published model. Default: the only one that "
        "there is, unless --signals is given.",
        show_default=False,
    ),
]
Signals = Annotated[
    str | None,
    typer.Option(
        help="Instead of a published model: signals to fit, separated by commas; 'catalogue' is "
        "all inputs."
    ),
]
FeatureSetOption = Annotated[
    str | None,
    typer.Option(
        "--features", help="Feature set that --signals are of. Default: the logged signals."
    ),
]


@dataclass(frozen=True)
class Examined:
    """What a command examines: the inputs of a published model, or named ones."""

    feature_set: str
    named: str | None
    version: ModelVersion | None

    def inputs(self, warehouse: Warehouse, condition: str) -> tuple[str, ...]:
        """Return the inputs; all that the cohort has, if that was asked for."""
        if self.version is not None:
            return self.version.manifest.signals
        cohort = load_cohort(warehouse, condition, self.feature_set)
        return inputs_of(cohort, self.named or WHOLE_SET)


def subject_of(
    warehouse: Warehouse, reference: str | None, signals: str | None, feature_set: str | None
) -> Examined:
    """Return what is to be examined. Raises `ConfigError` if a model and signals are named."""
    if signals is not None or feature_set is not None:
        if reference is not None:
            raise ConfigError("name a published model or --signals (of --features), not both.")
        return Examined(feature_set or PLAIN, signals, None)
    registry = registry_of(warehouse)
    version = registry.resolve(reference or _only_model(registry))
    identity = version.manifest.trained_on.feature_set
    return Examined(features().name_of(identity), None, version)


def _only_model(registry: Registry) -> str:
    names = registry.names()
    if len(names) == 1:
        return names[0]
    known = ", ".join(names) or "none"
    raise QuestionError(f"name a published model, or --signals. Published: {known}.")


def quantities(values: Sequence[str] | None, option: str) -> dict[str, float]:
    """Return what options like `--noise ay=0.2` say, in SI units. Raises `ConfigError`."""
    found = {}
    for value in values or ():
        name, _, number = value.partition("=")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            raise ConfigError(
                f"{option} {value}: write SIGNAL=NUMBER in SI units, such as ay=0.2."
            ) from None
    return found
