"""The features in force: `configs/features.toml`, and one's own laid over it."""

from collections.abc import Mapping
from fractions import Fraction
from functools import cache
from importlib.resources.abc import Traversable

from pydantic import ValidationError

from fleet_slip.catalogue.feature_catalogue import FeatureCatalogue
from fleet_slip.catalogue.row_features import Feature
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.time_columns import TimeColumn
from fleet_slip.config import faults_of, load_config, load_toml
from fleet_slip.errors import ConfigError
from fleet_slip.resources import config_file, folder


def load_features(file: Traversable) -> FeatureCatalogue:
    """Read a file of features. Raises `ConfigError`."""
    return load_config(file, FeatureCatalogue)


def load_features_over(shipped: Traversable, own: Traversable) -> FeatureCatalogue:
    """Read a file of features laid over another: what it names is added, or takes the place.

    Raises `ConfigError`.
    """
    content = load_toml(shipped)
    for kind, entries in load_toml(own).items():
        if kind not in content or not isinstance(entries, dict):
            raise ConfigError(f"{own}: {kind}: unknown key. Known: {', '.join(content)}.")
        content[kind] = {**content[kind], **entries}
    try:
        return FeatureCatalogue.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"{own}, over {shipped}: {faults_of(error)}") from None


@cache
def features() -> FeatureCatalogue:
    """Return the features that are in force: the shipped ones, and one's own over them."""
    shipped, chosen = folder("configs") / "features.toml", config_file("features.toml")
    if str(chosen) == str(shipped):
        return load_features(shipped)
    return load_features_over(shipped, chosen)


@cache
def input_scales() -> Mapping[str, Fraction]:
    """Return the physical value of one count of every input signal, feature and the label."""
    signals = catalogue()
    usable = (*signals.feature_inputs, signals.label)
    scales = {name: signals[name].exact_scale for name in usable}
    known = features()
    columns: dict[str, Feature | TimeColumn] = {**known.features, **known.time_columns}
    return scales | {name: one.exact_scale for name, one in columns.items()}
