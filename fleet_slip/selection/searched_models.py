"""A search among many inputs as candidates of a selection: models of 1, 2, ... columns.

How well a size does is found by making the whole search again inside every training fold, so that
nothing of a fold is seen in choosing for it. That needs the Gram of each fold and no single drive.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.catalogue.features import input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError
from fleet_slip.grams.cohorts.fold_sums import SummedCohort
from fleet_slip.grams.cohorts.folding import Folding
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.regression.choice.nested_choice import nested_fits
from fleet_slip.regression.choice.stepwise import stepwise_order
from fleet_slip.regression.choice.winner import DEFAULT_WORTH, Winner, Worth, choose
from fleet_slip.regression.exact.figures import ErrorSums
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import Fit, fit
from fleet_slip.regression.validation.crossval import CrossValidation, assemble, held_out_errors
from fleet_slip.regression.validation.folds import Folds
from fleet_slip.selection.model_list import Search


@dataclass(frozen=True)
class SearchedModels:
    """The models of a search: one of each size, cross-validated with the search made again.

    Attributes:
        search: how it was searched.
        inputs: how many inputs there were to choose among.
        models: of sizes 1, 2, ...
    """

    search: Search
    inputs: int
    models: tuple[CrossValidation, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {**self.search.model_dump(), "inputs": self.inputs, "sizes": len(self.models)}


def search_models(
    cohort: Cohort | SummedCohort,
    inputs: Sequence[str],
    folding: Folding,
    search: Search,
    *,
    intercept: bool = True,
) -> SearchedModels:
    """Search among the inputs on the drives that have them all.

    Raises `DataError` if no drive has them all, or if no column tells anything.
    """
    label = catalogue().label
    folds = cohort.folds(folding.by, folding.count).serving(inputs, label)

    def fits(gram: Gram) -> list[Fit]:
        return _fits(gram if intercept else gram.about_origin(), inputs, label, search)

    chosen = fits(folds.total)
    tests: list[list[ErrorSums]] = [[] for _ in chosen]
    for fold in folds.grams:
        training = folds.total - fold
        for sums, fitted in zip(tests, fits(training), strict=False):
            sums.append(held_out_errors(fitted.model, training, fold))
    models = tuple(
        _model(folds, sums, fitted, search)
        for sums, fitted in zip(tests, chosen, strict=True)
        if len(sums) == len(folds.grams)
    )
    if not models:
        raise DataError("every input is constant or depends on others: there is nothing to choose.")
    return SearchedModels(search, len(inputs), models)


def _model(folds: Folds, sums: Sequence[ErrorSums], fitted: Fit, search: Search) -> CrossValidation:
    name = f"{search.method} {fitted.size}"
    return assemble(name, folds, sums, fitted.model, input_scales())


def _fits(gram: Gram, inputs: Sequence[str], label: str, search: Search) -> list[Fit]:
    """Return the exact fits of the sets that a search chooses, of sizes 1, 2, ..."""
    sets = stepwise_order(gram, inputs, label, search.method, search.most)
    nested = all(sets[size][:-1] == sets[size - 1] for size in range(1, len(sets)))
    if sets and nested:
        return nested_fits(gram, sets[-1], label)[1:]
    return [fit(gram, chosen, label) for chosen in sets]


def choose_by(
    search: Search | None, models: Sequence[CrossValidation], worth: Worth = DEFAULT_WORTH
) -> Winner:
    """Return the winner of cross-validated models by the rule of a search.

    The rule `best` gives way to a worth that was asked for.
    """
    if search is None or search.rule != "best" or worth != DEFAULT_WORTH:
        return choose(models, worth)
    best = max(models, key=lambda model: model.sums.signed_r_squared)
    reason = (
        f"Model {best.name} has the best cross-validated correlation, {best.correlation:.6f}, "
        f"which is the rule of its list; the columns of each size were chosen again in every fold."
    )
    return Winner(best, best, reason)
