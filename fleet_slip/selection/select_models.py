"""Compares candidate models on a cohort by cross-validation and chooses one; no log row is read."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Generic

from typing_extensions import TypeVar

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.cohorts.fold_sums import SummedCohort
from fleet_slip.grams.cohorts.folding import ROW_FOLDS, Folding
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.pages.notebook_table import notebook_table
from fleet_slip.regression.choice.nested_choice import NestedDistances
from fleet_slip.regression.choice.winner import Winner, Worth
from fleet_slip.regression.inference.influential import Influential
from fleet_slip.regression.validation.crossval import CrossValidation, cross_validate_inputs
from fleet_slip.regression.validation.folds import CohortFolds
from fleet_slip.selection.model_list import CandidateModel, Search
from fleet_slip.selection.request import SelectionRequest
from fleet_slip.selection.search import (
    SearchChoice,
    SearchedModels,
    choose_by,
    search_models,
)
from fleet_slip.selection.uncertainty import Uncertainty
from fleet_slip.selection.without_label import WithoutLabel

AnyCohort = TypeVar("AnyCohort", bound=Cohort | SummedCohort, default=Cohort)


@dataclass(frozen=True)
class Selection(Generic[AnyCohort]):
    """All candidates with their figures, in the order of the list, and the winner.

    Attributes:
        cohort: the Gram rows, or their sums.
        skipped: candidates that the cohort cannot serve, with the reason.
        choice: how an order or a subset was chosen; None for a list of models.
        searched: the models of a search, which are among `models`.
        distances: of an order's nested models from the full and the true one, or why not told.
        intercept: whether models have one; without it they go through the origin.
    """

    cohort: AnyCohort
    folds: Folding
    models: tuple[CrossValidation, ...]
    winner: Winner
    skipped: dict[str, str]
    choice: SearchChoice | None = None
    searched: SearchedModels | None = None
    uncertainty: Uncertainty | None = None
    distances: NestedDistances | str | None = None
    intercept: bool = True

    def __repr__(self) -> str:
        winner = self.winner.model
        return (
            f"<{type(self).__name__}: {winner.name}, {len(winner.signals)} signals, RMSE "
            f"{winner.pooled.rmse_deg:.4f} deg, correlation {winner.correlation:.4f}, of "
            f"{len(self.models)} models; {self.cohort.drive_count:,} drives where "
            f"{self.cohort.condition.text}>"
        )

    def _repr_html_(self) -> str:
        best = sorted(self.models, key=lambda model: model.pooled.rmse)[:10]
        rows = [
            [
                one.name,
                str(len(one.signals)),
                f"{one.correlation:.4f}",
                f"{one.pooled.rmse_deg:.4f}",
            ]
            for one in best
        ]
        header = ["model", "signals", "correlation", "RMSE deg"]
        title = f"winner: {self.winner.model.name}. {self.winner.reason}"
        return notebook_table(title, header, rows, [one.pooled.rmse_deg for one in best])

    @property
    def rows_without(self) -> int:
        """Rows of the cohort that tell nothing of the winner: the label or a column is missing."""
        return max(self.cohort.rows - self.winner.model.pooled.rows, 0)

    def _gram_rows(self, model: CrossValidation) -> dict[str, str]:
        """Return which Gram rows a model is made of, for SQL; it may name cars."""
        return {"gram_rows": self.cohort.gram_condition(model.signals)}

    def as_dict(self) -> dict[str, Any]:
        """Return what `select --json` prints."""
        document: dict[str, Any] = {
            "models": [{**model.as_dict(), **self._gram_rows(model)} for model in self.models],
            "winner": self.winner.model.name,
            "reason": self.winner.reason,
            "cohort": self.cohort.condition.text,
            "feature_set": features().identity(self.cohort.feature_set),
            "drives": self.cohort.drive_count,
            "rows": self.cohort.rows,
            "rows_without": self.rows_without,
            "drives_without_log": self.cohort.members.count_received,
            "drives_left_out": self.cohort.left_out,
            "intercept": self.intercept,
            "folds": {
                "by": self.folds.by,
                "count": len(self.models[0].folds),
                "leaking": self.folds.by == ROW_FOLDS,
            },
            "skipped": self.skipped,
        }
        for model, shortfall in zip(document["models"], self.winner.shortfalls, strict=False):
            model["shortfall"] = shortfall.as_dict()
        if self.choice is not None:
            document["choice"] = self.choice.as_dict()
        if self.searched is not None:
            document["search"] = self.searched.as_dict()
        if isinstance(self.distances, str):
            document["nested"] = {"left_out": self.distances}
        elif self.distances is not None:
            document["nested"] = self.distances.as_dict()
        if self.uncertainty is not None:
            document["uncertainty"] = asdict(self.uncertainty)
        return document


def select(
    cohort: AnyCohort,
    candidates: Sequence[CandidateModel],
    folds: Folding,
    worth: Worth | None = None,
    search: Search | None = None,
    inputs: Sequence[str] = (),
    *,
    intercept: bool = True,
) -> Selection[AnyCohort]:
    """Cross-validate each candidate, and what a search finds among inputs; choose the winner.

    `worth` overrides the search's rule. Candidates with absent or dependent signals are skipped,
    with the reason. Raises `DataError` if none is left, or no drive has the label.
    """
    divided = cohort.folds(folds.by, folds.count)
    label = catalogue().label
    if not any(label in grams[0].signals for grams in divided.tables):
        raise DataError(
            f"no drive of the cohort {cohort.condition.text!r} has the label, {label}. Where cars "
            "log their course, learn from it: fleet-slip select --label course"
        )
    models: list[CrossValidation] = []
    skipped: dict[str, str] = {}
    for candidate in candidates:
        try:
            models.append(validate(candidate, divided, intercept=intercept))
        except (DataError, QuestionError) as error:
            skipped[candidate.name] = str(error)
    searched = None
    if search:
        searched = search_models(cohort, inputs, folds, search, intercept=intercept)
    if searched is not None:
        models += searched.models
    if not models:
        reasons = "; ".join(f"model {name}: {reason}" for name, reason in skipped.items())
        raise DataError(f"no candidate can be fitted on the cohort. {reasons}")
    winner = choose_by(search, models, worth)
    return Selection(
        cohort, folds, tuple(models), winner, skipped, searched=searched, intercept=intercept
    )


def validate(
    candidate: CandidateModel, folds: CohortFolds, *, intercept: bool = True
) -> CrossValidation:
    """Cross-validate one candidate by exact least squares in each fold."""
    return cross_validate_inputs(
        candidate.name,
        folds,
        candidate.signals,
        catalogue().label,
        input_scales(),
        intercept=intercept,
    )


@dataclass(frozen=True, kw_only=True, repr=False)
class RequestedSelection(Selection[Any]):
    """A selection that can be published: it tells what it was made from.

    Attributes:
        model_list, config_sha256: what was compared, such as `table1`, and its checksum.
        left_out: the cars that `robust` left out, and what influence they had.
        without_label: what changes of the course tell of the winner, if they taught it alone.
        label_noise_deg: of the label, which every error has in it; None where it is not known.
        request, asked: what was asked for, and of which drives.
        remark: why another list than the usual one was compared.
        examined: which drives were left out since they are not in order, as a sentence.
    """

    model_list: str
    config_sha256: str
    left_out: Mapping[str, Influential] = field(default_factory=dict)
    without_label: WithoutLabel | None = None
    label_noise_deg: float | None = None
    request: SelectionRequest = field(default_factory=SelectionRequest)
    asked: str = TRAINING_DRIVES
    remark: str = ""
    examined: str = ""

    @property
    def beyond_label_noise_deg(self) -> float | None:
        """The winner's RMSE without the label's noise."""
        if self.label_noise_deg is None:
            return None
        rmse_deg = self.winner.model.pooled.rmse_deg
        return math.sqrt(max(rmse_deg**2 - self.label_noise_deg**2, 0.0))

    def as_dict(self) -> dict[str, Any]:
        """Return what `select --json` prints."""
        named = {car: one.times for car, one in self.left_out.items()}
        document = {
            **super().as_dict(),
            "vehicles_left_out": named,
            "label_noise_deg": self.label_noise_deg,
        }
        course = {"without_label": self.without_label.as_dict()} if self.without_label else {}
        said = {"remark": self.remark, "examined": self.examined}
        return {**document, **course, **{name: text for name, text in said.items() if text}}

    @classmethod
    def of(
        cls, selection: Selection[Any], model_list: str, config_sha256: str
    ) -> "RequestedSelection":
        """Return a selection with what it was made from."""
        return cls(**vars(selection), model_list=model_list, config_sha256=config_sha256)
