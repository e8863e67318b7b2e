"""Which model wins: the fewest signals within one standard error of the best.

The one-standard-error rule is that of Breiman, Friedman, Olshen and Stone, Classification and
Regression Trees (1984), section 3.4.3: differences below the uncertainty of the estimate do not
justify a richer model.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from fleet_slip.errors import QuestionError
from fleet_slip.regression.crossval import CrossValidation


@dataclass(frozen=True)
class Winner:
    """The chosen model, the best-correlated one, and the reason in a sentence."""

    model: CrossValidation
    best: CrossValidation
    reason: str


def choose(models: Sequence[CrossValidation]) -> Winner:
    """Return the winner of cross-validated models, given in their declared order.

    The best pooled correlation is the reference. Among the models whose correlation is at most one
    standard error (of the best, over its folds) below it, the fewest signals win; then the higher
    exact correlation; then the declared order. Raises `QuestionError` for an empty list.
    """
    if not models:
        raise QuestionError("no model to choose from: the list of models is empty.")
    best = max(models, key=lambda model: model.sums.signed_r_squared)
    threshold = best.correlation - best.standard_error
    near = [model for model in models if model is best or model.correlation >= threshold]
    fewest = min(len(model.signals) for model in near)
    smallest = [model for model in near if len(model.signals) == fewest]
    winner = max(smallest, key=lambda model: model.sums.signed_r_squared)
    return Winner(winner, best, _reason(winner, best, len(near)))


def _reason(winner: CrossValidation, best: CrossValidation, near: int) -> str:
    error = best.standard_error
    if winner is best:
        rivals = "no other model is" if near == 1 else "no model with fewer signals is"
        return (
            f"Model {best.name} has the best cross-validated correlation, {best.correlation:.4f}, "
            f"and {rivals} within one standard error ({error:.2g}) of it."
        )
    return (
        f"Model {winner.name} has the fewest signals ({len(winner.signals)}) of the {near} models "
        f"within one standard error ({error:.2g}) of the best cross-validated correlation, "
        f"{best.correlation:.4f} (model {best.name}, {len(best.signals)} signals); its own is "
        f"{winner.correlation:.4f}."
    )
