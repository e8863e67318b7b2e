"""Inputs as users name them: separated by commas, or all at once."""

from collections.abc import Sequence

from fleet_slip.catalogue.features import features
from fleet_slip.errors import QuestionError, UsageError
from fleet_slip.grams.cohorts.fold_sums import SummedCohort
from fleet_slip.grams.cohorts.gram_cohort import Cohort

WHOLE_SET = "catalogue"
"""As an order of signals: all inputs of the feature set, in its order."""


def inputs_of(cohort: Cohort | SummedCohort, order: str) -> tuple[str, ...]:
    """Return an order of inputs from text, `catalogue` meaning all that the cohort has.

    Raises what `require_inputs` raises.
    """
    if order == WHOLE_SET:
        return cohort.inputs
    return require_inputs(order.split(","), cohort.feature_set)


def require_inputs(names: Sequence[str], feature_set: str) -> tuple[str, ...]:
    """Return the names of inputs of a feature set.

    Raises `QuestionError` for an unknown input, and `UsageError` for one that stands twice.
    """
    known = features().feature_set(feature_set).inputs
    order = tuple(name.strip() for name in names)
    if unknown := [name for name in order if name not in known]:
        raise QuestionError(
            f"{','.join(order)}: {', '.join(unknown)} is not an input. Inputs of the feature set "
            f"{feature_set}: {', '.join(known)}."
        )
    if len(set(order)) < len(order):
        raise UsageError(f"{','.join(order)}: an input stands twice.")
    return order
