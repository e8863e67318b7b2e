"""How to select: the one definition of what `FleetCohort.select` and `fleet-slip select` take."""

import math
import re
from dataclasses import dataclass
from typing import Annotated, Literal

from typing_extensions import Doc

from fleet_slip.errors import UsageError
from fleet_slip.grams.cohorts.folding import FoldKey
from fleet_slip.regression.choice.signal_orders import RANKINGS
from fleet_slip.regression.choice.stepwise import METHODS
from fleet_slip.regression.choice.subsets import CRITERIA
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

DEFAULT_MOST = 24

WORTH = Doc(
    "The smallest gain that is worth a signal: as an angle such as 0.025deg, the root of the "
    "difference of the mean squared errors, in which the label's noise cancels; or a share of the "
    "RMSE, such as 2%. Of the models that fall less short of the best, or by no more than one "
    "standard error of the difference, that with the fewest signals wins. Default: 0.025deg, or "
    "the rule of the list."
)

NAIVE = Doc(
    "Take rows for independent evidence, not drives or cars. At 100 Hz they are not: then every "
    "criterion keeps nearly everything."
)
CLUSTER = Doc(
    "What is independent evidence: vehicle, since a car's drives share its biases and tyres, or "
    "drive. Default: vehicle where there are several, else drive."
)

_WORTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+) ?(deg|%)")


@dataclass(frozen=True, kw_only=True)
class SelectionRequest:
    """How models are compared and one is chosen; without options, by the usual list."""

    models: Annotated[
        str | None,
        Doc(
            f"A model list of configs/models, or a TOML file. Default: {DEFAULT_MODELS}, or "
            f"{LOGGED_MODELS} with `features` or without its Gram rows, unless `nested` or an "
            "option that searches is given."
        ),
    ] = None
    model: Annotated[
        str | None,
        Doc(
            "The inputs of the one model to take, separated by commas, such as "
            '"ax, ay, yaw_rate", instead of a list.'
        ),
    ] = None
    nested: Annotated[
        str | None,
        Doc(
            "Add the nested models of an order of signals, separated by commas; 'catalogue' is all "
            "inputs in the order of configs/signals.toml, a family of windows or gates its "
            "columns."
        ),
    ] = None
    features: Annotated[
        str | None,
        Doc(
            "Feature set of configs/features.toml, computed before with: fleet-slip gram "
            "--features NAME. Default: what the list says, else the logged signals."
        ),
    ] = None
    label: Annotated[
        Label | None,
        Doc(
            "course: learn without a reference sensor, from changes of the course over ground; "
            "course+sideslip: from these, and the label of the cars that have it. Feature set and "
            "model list are then those called course, unless others are named."
        ),
    ] = None
    by: Annotated[
        FoldKey | None,
        Doc("What a fold is made of. Default: what the list says. By row is WEKA's way and leaks."),
    ] = None
    folds: Annotated[
        int | str | None,
        Doc(
            "Number of folds, or each: every drive, or whatever folds are made of, is a fold of "
            "its own. Default: what the list says."
        ),
    ] = None
    rank: Annotated[
        str | None,
        Doc(f"Rank the inputs of `nested` first: {', '.join(RANKINGS)}. Default: declared."),
    ] = None
    criterion: Annotated[
        str | None,
        Doc(
            "What decides how many of the ranked inputs are kept: cv (the smallest model that "
            f"falls negligibly short of the best; see `worth`), {', '.join(CRITERIA)}. Default: cv."
        ),
    ] = None
    worth: Annotated[str | None, WORTH] = None
    all_subsets: Annotated[
        bool, Doc("Search all subsets of the inputs of `nested` instead of an order.")
    ] = False
    robust: Annotated[
        bool,
        Doc(
            "Leave out the cars whose influence on the model no honest car of their rows has, and "
            "say which; diagnose says it before."
        ),
    ] = False
    naive: Annotated[bool, NAIVE] = False
    cluster: Annotated[ClusterUnit | None, CLUSTER] = None
    intercept: Annotated[
        bool,
        Doc(
            "Whether models have an intercept. Without it they go through the origin: a car that "
            "drives straight on then has no side-slip, and no sensor an offset."
        ),
    ] = True
    search: Annotated[
        str | None,
        Doc(
            f"Search among the inputs of `nested`, or all: {', '.join(METHODS)}; the search is "
            "made again in every fold. Adds its models of 1, 2, ... columns."
        ),
    ] = None
    most: Annotated[int | None, Doc(f"Most columns of `search`. Default: {DEFAULT_MOST}.")] = None
    repeat: Annotated[
        int | None, Doc("Cross-validate the winner again with so many other deals of folds.")
    ] = None
    bootstrap: Annotated[
        int | None,
        Doc("Confidence interval of the winner's correlation by drawing the drives so many times."),
    ] = None

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
