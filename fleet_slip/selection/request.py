"""What to select, as it is asked for on the command line."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import UsageError
from fleet_slip.grams.cohorts.folding import FoldKey
from fleet_slip.regression.inference.drive_moments import ClusterUnit
from fleet_slip.selection.select_models import Selection
from fleet_slip.selection.worth import WORTH, parse_worth
from fleet_slip.warehouse.minimum_cohort import tells_single_cars

DEFAULT_MODELS = "table1"

Label = Literal["course"]
"""What may stand for the label of a reference sensor."""

COURSE: Label = "course"
"""Also the name of the feature set, and of the model list, that are taken for it."""


@dataclass(frozen=True, kw_only=True)
class SelectionRequest:
    """What to select.

    Attributes:
        cohort: SQL condition on the view `drives`.
        models: name or path of a model list; by default `table1`, unless signals are named.
        model: inputs of the one model to take, separated by commas, instead of a list.
        nested: order of inputs, separated by commas, or `catalogue`; adds its nested models.
        features: name of the feature set; by default what the list says, or what the folds need.
        label: `course` to learn from changes of the course, by a feature set of them.
        by, folds: how to fold; by default what the list says.
        rank, criterion: rank the inputs of `nested` first; choose by a criterion.
        all_subsets: choose among the best subsets of `nested` instead of an order's.
        worth: gain in RMSE for which cross-validation keeps a signal, such as `0.005deg` or `2%`.
        robust: leave out the cars whose influence on the model is unusual.
        naive: take rows for independent instead of drives or cars.
        cluster: what is independent; by default cars where there are several, else drives.
        intercept: whether models have one; without it they go through the origin.
        search, most: search among the inputs of `nested`, or all, for models of up to so many.
        bootstrap, repeat: how often to resample the winner's figures.
    """

    cohort: str = TRAINING_DRIVES
    models: str | None = None
    model: str | None = None
    nested: str | None = None
    features: str | None = None
    label: Label | None = None
    by: FoldKey | None = None
    folds: int | str | None = None
    rank: str | None = None
    criterion: str | None = None
    worth: str = WORTH
    all_subsets: bool = False
    robust: bool = False
    naive: bool = False
    cluster: ClusterUnit | None = None
    intercept: bool = True
    search: str | None = None
    most: int | None = None
    repeat: int | None = None
    bootstrap: int | None = None

    @property
    def ordered(self) -> bool:
        """Whether inputs are ranked or searched, rather than given models compared."""
        return bool(self.rank or self.criterion or self.all_subsets or self.naive)

    @property
    def resampled(self) -> bool:
        """Whether the winner's figures are resampled."""
        return bool(self.bootstrap or self.repeat)

    def check(self) -> None:
        """Raise `UsageError` for options that do not go together."""
        parse_worth(self.worth)
        if self.ordered and self.models:
            raise UsageError(
                "a list of models is compared by cross-validation as it stands: leave out "
                "models, or rank, criterion, all_subsets and naive, which search among the inputs "
                "of nested."
            )
        if self.model and (self.models or self.nested or self.ordered or self.search):
            raise UsageError(
                "model says which inputs to take: leave it out, or models, nested, rank, "
                "criterion, all_subsets, naive and search, which choose."
            )
        if self.rank and self.all_subsets:
            raise UsageError("a search of all subsets needs no order: leave out rank.")
        if self.most and not self.search:
            raise UsageError("most is for a search: say how to search.")
        evidence = self.ordered or self.bootstrap or self.nested
        if self.cluster and (self.naive or not evidence):
            raise UsageError(
                "cluster says what is independent evidence for nested, rank, criterion, "
                "all_subsets and bootstrap: leave it out, or naive."
            )
        if self.search and self.ordered:
            raise UsageError(
                "a search is made again in every fold, and looks at folds alone: leave out rank, "
                "criterion, all_subsets and naive."
            )


@dataclass(frozen=True, kw_only=True)
class RequestedSelection(Selection[Any]):
    """A selection that can be published: it tells what it was made from.

    Attributes:
        model_list: what was compared, such as `table1`.
        config_sha256: checksum of all that says what to compare.
        left_out: the cars that `robust` left out, and their influence as a multiple of the median.
    """

    model_list: str
    config_sha256: str
    left_out: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return what `select --json` prints."""
        named = dict(self.left_out) if tells_single_cars() else {}
        return {**super().as_dict(), "vehicles_left_out": named}

    @classmethod
    def of(
        cls, selection: Selection[Any], model_list: str, config_sha256: str
    ) -> "RequestedSelection":
        """Return a selection with what it was made from."""
        return cls(**vars(selection), model_list=model_list, config_sha256=config_sha256)
