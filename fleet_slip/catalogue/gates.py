"""Gates of `configs/features.toml` as types: `[gates.NAME]`."""

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise

from pydantic import Field, model_validator

from fleet_slip.catalogue.definitions import Gate
from fleet_slip.catalogue.signals import Identifier
from fleet_slip.catalogue.windows import TimeColumn
from fleet_slip.config import Config


class GateFamily(Config):
    """Several linear models with a blend between them, as columns: one for each knot but the first.

    At a knot one model holds alone; between two knots they are mixed in proportion. Weights add up
    to one, so that a model has the columns themselves and, for each further knot, what changes
    there. The column of a knot is called COLUMN_NAME_K, K from 1.
    """

    of: Identifier
    """The column over time that opens and closes the gates."""
    knots: tuple[Decimal, ...] = Field(min_length=2, max_length=20)
    """Physical values of it, rising; beyond the ends the outermost models hold."""
    columns: tuple[Identifier, ...] = Field(min_length=1)
    """Columns over time that are gated."""
    description: str = Field(min_length=1)

    @model_validator(mode="after")
    def _knots_rise(self) -> "GateFamily":
        if any(high <= low for low, high in pairwise(self.knots)):
            raise ValueError("the knots of a gate must rise")
        if len(set(self.columns)) < len(self.columns):
            raise ValueError("a column stands twice")
        return self

    def members(self, name: str) -> dict[str, tuple[str, int]]:
        """Return the names of the family's columns, and of each the column and the knot."""
        return {
            f"{column}_{name}_{knot}": (column, knot)
            for knot in range(1, len(self.knots))
            for column in self.columns
        }


def gated_columns(
    name: str, family: GateFamily, known: Mapping[str, TimeColumn]
) -> dict[str, TimeColumn]:
    """Return the members of a family of gates. Raises `ValueError` for what is no column."""
    unknown = [one for one in (family.of, *family.columns) if one not in known]
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: no column over time")
    by = known[family.of]
    counts = [round(Fraction(knot) / by.exact_scale) for knot in family.knots]
    found = {}
    for member, (column, knot) in family.members(name).items():
        base = known[column]
        gate = Gate(
            by=by.definition,
            low=counts[knot - 1],
            peak=counts[knot],
            high=counts[knot + 1] if knot + 1 < len(counts) else None,
        )
        found[member] = TimeColumn(
            definition=base.definition.model_copy(update={"gate": gate}),
            scale=base.scale,
            unit=base.unit,
            column=f"{base.column}_{name}_{knot}",
            description=f"{base.description}, where {family.of} is near {family.knots[knot]:f}",
        )
    return found
