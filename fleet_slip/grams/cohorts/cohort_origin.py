"""Which Gram rows a cohort is made of."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.warehouse.condition import Condition


@dataclass(frozen=True, kw_only=True)
class CohortOrigin:
    """Which Gram rows a cohort is made of, and which drives it leaves out.

    Attributes:
        condition: which drives, by the columns of the view `drives`.
        logs_version, grams_version, feature_set: what was read.
        left_out: drives of the condition that have no such Gram rows: their cars sent no log.
    """

    condition: Condition
    logs_version: int
    grams_version: int
    feature_set: str = PLAIN
    left_out: int = 0

    def inputs_among(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the inputs that are among some columns, in the order of the feature set."""
        known = set(names)
        return tuple(n for n in features().feature_set(self.feature_set).inputs if n in known)

    def gram_condition(self, inputs: Sequence[str]) -> str:
        """Return the SQL condition on the view `grams` of the rows that a model is made of."""
        known = features().calibrated
        stored = dict.fromkeys(known[name].of if name in known else name for name in inputs)
        wanted = ", ".join(f"'{name}'" for name in [*stored, catalogue().label])
        return (
            f"feature_set = '{features().identity(self.feature_set)}' AND {self.condition.sql} AND "
            f"list_has_all(string_split(signals, ','), [{wanted}])"
        )
