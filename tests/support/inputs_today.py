"""Inputs of learned rivals as the catalogue defines them today."""

from collections.abc import Sequence

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.columns.blocks.row_code import RowColumn
from fleet_slip.comparison.rivals.inputs import Inputs


def inputs_today(names: Sequence[str]) -> Inputs:
    """Return signals, features and columns over time by their names."""
    known, scales = features(), input_scales()
    rows = {n: RowColumn(n, parse(f.sql), f.limit) for n, f in known.features.items() if n in names}
    over_time = {n: known.time_columns[n].definition for n in names if n in known.time_columns}
    return Inputs({name: float(scales[name]) for name in names}, rows, over_time)
