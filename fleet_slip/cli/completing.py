"""What Tab completes in a shell of the system: names of models, campaigns, lists and feature sets.

Completion never fails and never speaks: where names cannot be read, there are none.
"""

import os
from collections.abc import Callable
from pathlib import Path

import typer

from fleet_slip.errors import FleetSlipError
from fleet_slip.resources import CONFIG_VARIABLE, config_names

Complete = Callable[[typer.Context, str], list[str]]


def complete_model(context: typer.Context, incomplete: str) -> list[str]:
    """Return the models that a word may become, or the versions of one after its @."""
    import fleet_slip  # noqa: PLC0415 - completion of other words need not wait for it
    from fleet_slip.models.versions import Registry  # noqa: PLC0415

    options = context.find_root().params
    try:
        registry = Registry(fleet_slip.open(options.get("root")).root / "models")
        name, at, _ = incomplete.partition("@")
        if at and name in registry.names():
            versions = [str(number) for number in reversed(registry.versions(name))]
            found = [f"{name}@{one}" for one in (*registry.history(name).aliases(), *versions)]
        else:
            found = registry.names()
    except (FleetSlipError, OSError):
        return []
    return [one for one in found if one.startswith(incomplete)]


def complete_config(kind: str) -> Complete:
    """Return what completes the names of the configs of one kind, such as `campaigns`."""

    def complete(context: typer.Context, incomplete: str) -> list[str]:
        _lay_over_configs(context)
        try:
            return [name for name in config_names(kind) if name.startswith(incomplete)]
        except (FleetSlipError, OSError):
            return []

    return complete


def complete_feature_set(context: typer.Context, incomplete: str) -> list[str]:
    """Return the feature sets that a word may become."""
    from fleet_slip.catalogue.feature_sets import PLAIN  # noqa: PLC0415
    from fleet_slip.catalogue.features import features  # noqa: PLC0415

    _lay_over_configs(context)
    try:
        return [name for name in (PLAIN, *features().sets) if name.startswith(incomplete)]
    except (FleetSlipError, OSError):
        return []


def _lay_over_configs(context: typer.Context) -> None:
    own = context.find_root().params.get("config")
    if own is not None:
        os.environ[CONFIG_VARIABLE] = str(Path(own).absolute())
