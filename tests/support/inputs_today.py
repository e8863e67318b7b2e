"""Inputs of learned rivals as the catalogue defines them today."""

from collections.abc import Sequence

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.comparison.rivals.inputs import Inputs


def inputs_today(names: Sequence[str]) -> Inputs:
    """Return signals, features and columns over time by their names."""
    known, scales = features(), input_scales()
    over_time = {n: known.time_columns[n].definition for n in names if n in known.time_columns}
    return Inputs({name: float(scales[name]) for name in names}, known.rows(names), over_time)
