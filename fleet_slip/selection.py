"""Compares candidate models on a cohort by cross-validation and chooses one; no log row is read."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.cohort import Cohort
from fleet_slip.errors import SelectionError
from fleet_slip.model_list import CandidateModel, FoldPlan
from fleet_slip.regression.crossval import CrossValidation, cross_validate_inputs
from fleet_slip.regression.folds import CohortFolds
from fleet_slip.regression.winner import Winner, choose
from fleet_slip.signals import catalogue


@dataclass(frozen=True)
class Selection:
    """All candidates with their figures, in the order of the list, and the winner."""

    cohort: Cohort
    folds: FoldPlan
    models: tuple[CrossValidation, ...]
    winner: Winner
    skipped: dict[str, str]
    """Candidates that the cohort cannot serve, with the reason."""

    def as_dict(self) -> dict[str, Any]:
        """Return what `select --json` prints."""
        return {
            "models": [model.as_dict() for model in self.models],
            "winner": self.winner.model.name,
            "reason": self.winner.reason,
            "cohort": self.cohort.condition,
            "drives": self.cohort.drives.num_rows,
            "rows": self.cohort.rows,
            "folds": {"by": self.folds.by, "count": self.folds.count},
            "skipped": self.skipped,
        }


def select(cohort: Cohort, candidates: Sequence[CandidateModel], folds: FoldPlan) -> Selection:
    """Cross-validate each candidate and choose the winner.

    A candidate that needs signals which no drive of the cohort has, or whose signals are linearly
    dependent, is skipped with the reason. Raises `SelectionError` if none is left.
    """
    divided = cohort.folds(folds.by, folds.count)
    models: list[CrossValidation] = []
    skipped: dict[str, str] = {}
    for candidate in candidates:
        try:
            models.append(validate(candidate, divided))
        except SelectionError as error:
            skipped[candidate.name] = str(error)
    if not models:
        reasons = "; ".join(f"model {name}: {reason}" for name, reason in skipped.items())
        raise SelectionError(f"no candidate can be fitted on the cohort. {reasons}")
    return Selection(cohort, folds, tuple(models), choose(models), skipped)


def validate(candidate: CandidateModel, folds: CohortFolds) -> CrossValidation:
    """Cross-validate one candidate by exact least squares in each fold."""
    signals = catalogue()
    scales = {name: signals[name].exact_scale for name in signals.gram_signals}
    return cross_validate_inputs(candidate.name, folds, candidate.signals, signals.label, scales)
