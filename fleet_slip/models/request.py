"""How to select: the one definition of what `FleetCohort.select` and `fleet-slip select` take."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Field,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)
from typing_extensions import Doc

from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config, load_config
from fleet_slip.errors import QuestionError, UsageError
from fleet_slip.grams.folding import Folding, FoldKey
from fleet_slip.regression.choice import DEFAULT_TOLERANCE, Tolerance
from fleet_slip.regression.drives import ClusterUnit
from fleet_slip.regression.orders import METHODS, RANKINGS
from fleet_slip.regression.subsets import CRITERIA

if TYPE_CHECKING:
    from fleet_slip.grams.cohort import Cohort

DEFAULT_MODELS = "estimator"
"""The model list that is compared unless another is named, by `run` and every night too."""

LOGGED_MODELS = "table1"
"""That of logged signals, for other feature sets or where the usual columns are not computed."""

Label = Literal["course"]
"""What may stand for the label of a reference sensor."""

COURSE_MODELS = COURSE_FEATURES = "course"
"""The model list, and the feature set, that are taken for it."""

DEFAULT_MOST = 24

WORTH = Doc(
    "The smallest gain that is worth a signal: as an angle such as 0.025deg, the root of the "
    "difference of the mean squared errors, in which the label's noise cancels; or a share of the "
    "RMSE, such as 2%. Of the models that fall less short of the best, or by no more than one "
    "standard error of the difference, that with the fewest signals wins. Default: 0.025deg, or "
    "the rule of the list."
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
            "course: learn without a reference sensor, from changes of the course over ground. "
            "Feature set and model list are then those called course, unless others are named."
        ),
    ] = None
    by: Annotated[
        FoldKey | None,
        Doc("What a fold is made of. Default: what the list says."),
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
            "Let drives whose error is more than three times that of the median drive count less, "
            "and say which; diagnose says it before."
        ),
    ] = False
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
    half_life: Annotated[
        int | None,
        Doc(
            "Days after which a drive counts half as much, a quarter after twice as many, and so "
            "on, before the cohort's newest day."
        ),
    ] = None
    prior: Annotated[
        str | None,
        Doc(
            "A campaign of configs/campaigns, or a TOML file, whose simulated drives join the "
            "training, with the weight that serves the cohort's held-out drives best, zero among "
            "them: fleet-slip identify --campaign."
        ),
    ] = None

    @property
    def ordered(self) -> bool:
        """Whether inputs are ranked or searched, rather than given models compared."""
        return bool(self.rank or self.criterion or self.all_subsets)

    def check(self) -> None:
        """Raise `UsageError` for options that do not go together."""
        parse_worth(self.worth)
        if self.ordered and self.models:
            raise UsageError(
                "a list of models is compared by cross-validation as it stands: leave out "
                "models, or rank, criterion and all_subsets, which search among the inputs of "
                "nested."
            )
        if self.model and (self.models or self.nested or self.ordered or self.search):
            raise UsageError(
                "model names the inputs itself: leave out models, nested, rank, criterion, "
                "all_subsets and search, or leave out model."
            )
        if self.rank and self.all_subsets:
            raise UsageError("a search of all subsets needs no order: leave out rank.")
        if self.most and not self.search:
            raise UsageError("most limits a search: give search, too.")
        if self.cluster and not (self.ordered or self.nested):
            raise UsageError(
                "cluster says what is independent evidence for nested, rank, criterion and "
                "all_subsets: leave it out."
            )
        ranked = self.ordered or (self.nested and not self.search)
        if self.prior and (self.label or ranked):
            raise UsageError(
                "a prior works with a model list, one model or a search: leave out label, rank, "
                "criterion, all_subsets, and nested without search."
            )
        if self.half_life is not None and self.half_life < 1:
            raise UsageError("half_life: give a whole number of days, at least 1.")
        if self.search and self.ordered:
            raise UsageError(
                "a search is made again in every fold, and looks at folds alone: leave out rank, "
                "criterion and all_subsets."
            )


def parse_worth(text: str | None) -> Tolerance:
    """Return a gain from text such as `0.025deg` or `2%`, or the usual one. Raises `UsageError`."""
    if text is None:
        return DEFAULT_TOLERANCE
    found = _WORTH.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"worth = {text}: write an angle such as 0.025deg, or a share of the best RMSE such as "
            "2%."
        )
    amount = float(found[1])
    return (
        Tolerance(amount / 100, relative=True)
        if found[2] == "%"
        else Tolerance(math.radians(amount))
    )


# Model lists: the candidates that a selection compares, read from `configs/models/*.toml`.

INPUTS_TOLD = 30
"""Inputs, or families of them, in a message."""


def expand_families(names: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
    """Replace a family of windows or gates by its members; needs the `Catalog` as context."""
    if (catalog := _catalog_of(info)) is None:
        return names
    return tuple(member for name in names for member in catalog.members(name))


def _catalog_of(info: ValidationInfo) -> Catalog | None:
    """Return the catalog to check names against: the context of a model list that is read."""
    return info.context if isinstance(info.context, Catalog) else None


Members = Annotated[tuple[Identifier, ...], AfterValidator(expand_families)]
"""Names of inputs; in a file, families stand for their members."""


class CandidateModel(Config):
    """A named set of signals or features; a family of windows or gates stands for its members."""

    name: str = Field(min_length=1, max_length=60)
    signals: Annotated[Members, Field(min_length=1)]

    @model_validator(mode="after")
    def _signals_are_inputs(self, info: ValidationInfo) -> "CandidateModel":
        if catalog := _catalog_of(info):
            inputs = catalog.inputs
            for name in self.signals:
                if name not in inputs:
                    raise ValueError(
                        f"model {self.name!r}: {name!r} is not an input. Inputs: "
                        f"{name_inputs(catalog, inputs)}"
                    )
        if len(set(self.signals)) < len(self.signals):
            raise ValueError(f"model {self.name!r} names a signal twice")
        return self


class Search(Config):
    """How to choose among many inputs: at most so many columns, by `rule`.

    `best` takes the best cross-validated correlation; `worth` the fewest columns whose error is
    negligibly larger (`fleet_slip.regression.choice`); `standard error` the fewest whose error is
    larger by at most one standard error over folds.
    """

    name: str | None = Field(default=None, min_length=1, max_length=40)
    """Of its models, before the number of columns. Default: the method."""
    inputs: Members | None = None
    """What to search among, families by their members. Default: all of the feature set."""
    method: Literal["forward", "backward", "exchange"] = "forward"
    most: int = Field(default=DEFAULT_MOST, ge=1, le=200)
    rule: Literal["best", "worth", "standard error"] = "worth"
    fewest_drives: int = Field(default=0, ge=0)
    """Of fewer drives nothing is searched for."""
    columns_per_drive: int | None = Field(default=None, ge=1)
    """At most so many columns for each drive, where whole drives are the folds."""

    def among(self, inputs: Sequence[str]) -> tuple[str, ...]:
        """Return which of a cohort's inputs are searched."""
        return tuple(name for name in inputs if self.inputs is None or name in self.inputs)


class ModelList(Config):
    """Candidates in their declared order, the feature set and the folds to compare them on.

    `label` may stand for a reference sensor. What each `search` finds joins, and the rule of the
    first decides. A file is validated with the `Catalog` as context.
    """

    description: str = Field(min_length=1)
    label: Label | None = None
    features: Identifier = PLAIN
    line: Annotated[str, Field(min_length=1)] | None = None
    """The list that the line is chosen from whose estimate is in the feature set."""
    folds: Folding = Folding()
    model: tuple[CandidateModel, ...] = Field(min_length=1)
    search: tuple[Search, ...] = ()

    @field_validator("search", mode="before")
    @classmethod
    def _one_search(cls, search: Any) -> Any:
        return search if isinstance(search, list | tuple) else (search,)

    @field_serializer("search")
    def _as_written(self, search: tuple[Search, ...]) -> Any:
        dumped = [one.model_dump(mode="json", exclude_defaults=True) for one in search]
        return dumped[0] if len(dumped) == 1 else dumped  # the checksum of a list with one

    @model_validator(mode="after")
    def _names_differ(self) -> "ModelList":
        names = [candidate.name for candidate in self.model]
        if len(set(names)) < len(names):
            raise ValueError("two models have the same name")
        return self

    @model_validator(mode="after")
    def _feature_set_has_the_inputs(self, info: ValidationInfo) -> "ModelList":
        if (catalog := _catalog_of(info)) is None:
            return self
        try:
            inputs = catalog.feature_set(self.features).inputs
        except QuestionError:
            raise ValueError(f"features: no feature set is called {self.features!r}") from None
        if absent := self.absent_from(inputs):
            raise ValueError(
                f"{', '.join(absent)} is not in the feature set {self.features!r}. Its inputs: "
                f"{', '.join(inputs)}"
            )
        return self

    def absent_from(self, inputs: Sequence[str]) -> list[str]:
        """Return the compared or searched columns that are not among the inputs."""
        named = [name for one in self.model for name in one.signals]
        named += [name for one in self.search for name in one.inputs or ()]
        return [name for name in dict.fromkeys(named) if name not in inputs]

    @property
    def sha256(self) -> str:
        """Checksum of what the list says, whatever its layout."""
        content = self.model_dump(mode="json", exclude_defaults=True)
        return sha256_of(canonical_json(content))


def load_model_list(catalog: Catalog, name_or_path: str) -> ModelList:
    """Return a model list of the catalog's configs, or of a TOML file. Raises `ConfigError`."""
    return load_config(catalog.configs.find("models", name_or_path), ModelList, catalog)


def nested_candidates(order: Sequence[str]) -> tuple[CandidateModel, ...]:
    """Return the models of an order's first 1..k inputs (paper, section II.B)."""
    return tuple(
        CandidateModel(name=f"first {size}", signals=tuple(order[:size]))
        for size in range(1, len(order) + 1)
    )


WHOLE_SET = "catalogue"
"""As an order of signals: all inputs of the feature set, in its order."""


def inputs_of(cohort: "Cohort", order: str) -> tuple[str, ...]:
    """Return the order of inputs in a text, `catalogue` being all; raises as `require_inputs`."""
    if order == WHOLE_SET:
        return cohort.inputs
    return require_inputs(cohort.catalog, order.split(","), cohort.feature_set)


def require_inputs(catalog: Catalog, names: Sequence[str], feature_set: str) -> tuple[str, ...]:
    """Return the inputs, of a family of windows or gates its members.

    Raises `QuestionError` for an unknown one, or one that is not odd of changes, `UsageError` for a
    repeated one.
    """
    inputs = catalog.feature_set(feature_set).inputs
    order = tuple(member for name in names for member in catalog.members(name.strip()))
    if unknown := [name for name in order if name not in inputs]:
        raise QuestionError(
            f"{','.join(order)}: {', '.join(unknown)} is not an input. Inputs of the feature set "
            f"{feature_set}: {name_inputs(catalog, inputs)}."
        )
    if len(set(order)) < len(order):
        raise UsageError(f"{','.join(order)}: an input appears twice.")
    require_odd(catalog, order, feature_set)
    return order


def require_odd(catalog: Catalog, names: Sequence[str], feature_set: str) -> None:
    """Raise `QuestionError` for columns of changes that are not odd in left and right."""
    if not catalog.feature_set(feature_set).change_ticks:
        return
    if even := [name for name in names if not catalog.is_odd(name)]:
        raise QuestionError(
            f"{', '.join(even)}: does not change sign where left and right are exchanged, as the "
            "side-slip angle does. Trained on course changes it would get a wrong constant: "
            "leave it out."
        )


def name_inputs(catalog: Catalog, inputs: Iterable[str]) -> str:
    """Return names of inputs in a line, families by their own, and how many more there are."""
    names = list(catalog.families(inputs))
    more = f" and {len(names) - INPUTS_TOLD} more (fleet-slip features)"
    return ", ".join(names[:INPUTS_TOLD]) + (more if len(names) > INPUTS_TOLD else "")
