"""How to select: the one definition of what `FleetCohort.select` and `fleet-slip select` take."""

import math
import re
from dataclasses import dataclass
from typing import Literal

from fleet_slip.errors import UsageError
from fleet_slip.grams.cohorts.folding import FoldKey
from fleet_slip.regression.choice.winner import DEFAULT_WORTH, Worth
from fleet_slip.regression.inference.drive_moments import ClusterUnit

DEFAULT_MODELS = "estimator"
"""The model list that is compared unless another is named, by `run` and every night too."""

LOGGED_MODELS = "table1"
"""That of logged signals, for other feature sets or where the usual columns are not computed."""

Label = Literal["course", "course+sideslip"]
"""What may stand for the label of a reference sensor, or beside it where few cars have one."""

COURSE = "course"
"""Also the name of the feature set, and of the model list, that are taken for it."""
BOTH: Label = "course+sideslip"
"""The course of most cars, and the label of those that have it."""

_WORTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+) ?(deg|%)")


@dataclass(frozen=True, kw_only=True)
class SelectionRequest:
    """How models are compared and one is chosen; without options, those of Table I.

    Attributes:
        models: a model list of `configs/models`, or the path of a TOML file; by default `estimator`
            unless inputs are named or searched, and `table1` where a feature set is named or the
            Gram rows of `estimator` are not there, which `remark` of the answer says.
        model: the inputs of the one model to take, separated by commas, instead of a list.
        nested: an order of inputs, separated by commas, or `catalogue` for all inputs; adds the
            nested models of its first 1, 2 ... inputs.
        features: a feature set; by default what the list says, else the logged signals.
        label: `course` to learn without a reference sensor, from changes of the course, or
            `course+sideslip` from these and the label of the cars that have it; the feature set and
            the list are then those called `course` unless others are named.
        by: what a fold is made of; by default what the list says. By `row` leaks.
        folds: how many folds, or `each`: every drive, or whatever folds are made of, is one.
        rank: ranks the inputs of `nested` first, such as `backward`.
        criterion: what decides how many of the ranked inputs are kept: `cv`, `bic` ...
        worth: the smallest gain that is worth a signal: of an error that the label's noise is no
            part of, such as `0.025deg`, or of the RMSE, such as `2%`; by default what the list
            says, which is the former unless its rule is the best correlation.
        all_subsets: search all subsets of the inputs of `nested` instead of an order.
        robust: leave out the cars whose influence on the model no honest car of their rows has;
            they are `left_out` of the answer, and its cohort names them.
        naive: take rows for independent evidence, not drives or cars.
        cluster: what is independent evidence, `vehicle` or `drive`; by default cars where there
            are several.
        intercept: whether models have one; without it they go through the origin.
        search: search among the inputs of `nested`, or all, in every fold, as by `exchange`.
        most: the most columns of `search`.
        repeat: cross-validate the winner again with so many other deals of folds.
        bootstrap: draw the drives so many times for an interval of the winner's correlation.
    """

    models: str | None = None
    model: str | None = None
    nested: str | None = None
    features: str | None = None
    label: Label | None = None
    by: FoldKey | None = None
    folds: int | str | None = None
    rank: str | None = None
    criterion: str | None = None
    worth: str | None = None
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
    def chosen_by_inputs(self) -> bool:
        """Whether models are made of an order or a search of inputs, and not of a list alone."""
        return bool(self.nested or self.ordered or self.search)

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
        if self.label == BOTH and (self.ordered or self.nested or self.resampled or self.robust):
            raise UsageError(
                "course+sideslip compares a list of models, one model or a search: leave out "
                "nested, rank, criterion, all_subsets, naive, robust, bootstrap and repeat."
            )
        if self.search and self.ordered:
            raise UsageError(
                "a search is made again in every fold, and looks at folds alone: leave out rank, "
                "criterion, all_subsets and naive."
            )


def parse_worth(text: str | None) -> Worth:
    """Return a gain from text such as `0.025deg` or `2%`, or the usual one. Raises `UsageError`."""
    if text is None:
        return DEFAULT_WORTH
    found = _WORTH.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"worth = {text}: write an angle such as 0.025deg, or a share of the best RMSE such as "
            "2%."
        )
    amount = float(found[1])
    return Worth(amount / 100, relative=True) if found[2] == "%" else Worth(math.radians(amount))
