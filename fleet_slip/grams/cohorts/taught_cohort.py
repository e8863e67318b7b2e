"""Labels of few cars and the course of all others as one cohort: a weighted sum.

Rows with the label count about their drive's mean, since changes have no constant either: it
follows from cars that go straight on (`fleet_slip.models.straight_on`). Only these drives are
tested on; the course of others is always trained on, with a weight.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.folding import FOLD_KEYS, FoldCount, FoldKey
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.grams.cohorts.members import Members
from fleet_slip.grams.cohorts.sweeping import about_mean
from fleet_slip.regression.validation.folds import CohortFolds
from fleet_slip.warehouse.condition import Condition
from fleet_slip.warehouse.tables import Warehouse


@dataclass(frozen=True, kw_only=True)
class TaughtCohort(Cohort):
    """The drives with the label, and the changes of others, whose rows have a `weight` beside 1."""

    others: Cohort
    weight: Fraction

    @property
    def members(self) -> Members:
        """Which drives and cars teach, with a label or without."""
        return super().members + self.others.members

    @property
    def inputs(self) -> tuple[str, ...]:
        """The columns that drives with the label and changes of the others both have."""
        others = set(self.others.inputs)
        return tuple(name for name in super().inputs if name in others)

    def count_others(self, signals: Collection[str]) -> tuple[int, int]:
        """Return how many drives, and changes, teach beside those with the label."""
        served = [one for one in self.others.tables if set(signals) <= set(one.signals)]
        drives = len(self.others.members.drives_with(signals))
        return drives, sum(int(one.n.sum()) for one in served)

    def folds(self, by: FoldKey, count: FoldCount) -> CohortFolds:
        """Divide the drives with the label into folds; what the others teach is in none."""
        values = set(self.drives[FOLD_KEYS[by]].to_pylist())
        if by == "vehicle" and len(values) == 1:
            by = "drive"
        beside = tuple(table.total() for table in self.others.tables)
        return replace(super().folds(by, count), beside=beside, weight=self.weight)


def load_taught(
    warehouse: Warehouse, condition: str | Condition, feature_set: str, by: FoldKey
) -> TaughtCohort:
    """Read the Gram rows of the drives that satisfy a condition, of both kinds; the weight is 1.

    What folds are made of teaches by its label alone if it has one. Raises `DataError` if no drive
    has one, or all have, and as `load_cohort`.
    """
    base = features().feature_set(feature_set).of
    if base is None:
        raise DataError(
            f"the feature set {feature_set} is not of another, whose Gram rows have the label. Use "
            "one that has of in configs/features.toml, such as course."
        )
    return taught_by(
        load_cohort(warehouse, condition, base), load_cohort(warehouse, condition, feature_set), by
    )


def taught_by(every: Cohort, changes: Cohort, by: FoldKey) -> TaughtCohort:
    """Return what the drives of a cohort with the label teach, and the changes of the others."""
    label = catalogue().label
    labelled = every.part(
        np.repeat([label in one.signals for one in every.tables], [len(t) for t in every.tables])
    )
    if not labelled.tables:
        raise DataError(
            f"no drive of the cohort {every.condition.text!r} has the label. Learn from the course "
            "alone: fleet-slip select --label course"
        )
    key = FOLD_KEYS["vehicle" if by == "vehicle" and _cars(labelled) > 1 else "drive"]
    known = set(labelled.drives[key].to_pylist())
    alone = np.array([one not in known for one in changes.drives[key].to_pylist()])
    if not alone.any():
        raise DataError(
            f"all drives of the cohort {every.condition.text!r} have the label. Learn from it "
            "alone: fleet-slip select"
        )
    tables = tuple(about_mean(table) for table in labelled.tables)
    own = {**vars(labelled), "feature_set": changes.feature_set, "tables": tables}
    own = {name: own[name] for name in Cohort.__dataclass_fields__}
    return TaughtCohort(**own, others=changes.part(alone), weight=Fraction(1))


def _cars(cohort: Cohort) -> int:
    return len(cohort.drives["vehicle_id"].unique())
