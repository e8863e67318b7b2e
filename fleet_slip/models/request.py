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
from fleet_slip.config import Config, load_config, refuse_renamed
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

DEFAULT_MAX_FEATURES = 24

TOLERANCE = Doc(
    "Smallest gain that justifies another signal: an angle such as 0.025deg, the root of the "
    "difference of the mean squared errors, in which the label's noise cancels; or a share of the "
    "RMSE, such as 2%. Among the models that are worse than the best by less than this, or by at "
    "most one standard error of the difference, the one with the fewest signals wins. Default: "
    "0.025deg, or the rule of the list."
)

CLUSTER = Doc(
    "Unit of independent evidence: vehicle, since drives of a car share its biases and tyres, or "
    "drive. Default: vehicle where there are several, else drive."
)

_TOLERANCE = re.compile(r"(\d+(?:\.\d*)?|\.\d+) ?(deg|%)")


@dataclass(frozen=True, kw_only=True)
class SelectionRequest:
    """Options of a selection; the default compares the default model list."""

    models: Annotated[
        str | None,
        Doc(
            f"Model list of configs/models, or a TOML file. Default: {DEFAULT_MODELS}, or "
            f"{LOGGED_MODELS} with `features` or without its Gram rows, unless `order` or an "
            "option that searches is given."
        ),
    ] = None
    model: Annotated[
        str | None,
        Doc("Inputs of a single model, separated by commas, instead of a list."),
    ] = None
    order: Annotated[
        str | None,
        Doc(
            "Compare the nested models of an order of signals, separated by commas; 'catalogue' is "
            "all inputs in the order of configs/signals.toml. A family of windows or gates stands "
            "for its columns."
        ),
    ] = None
    features: Annotated[
        str | None,
        Doc(
            "Feature set of configs/features.toml, computed before with: fleet-slip gram "
            "--features NAME. Default: the list's, else the logged signals."
        ),
    ] = None
    label: Annotated[
        Label | None,
        Doc(
            "course: learn from changes of the course over ground, without a reference sensor. "
            "The default feature set and model list are then those called course."
        ),
    ] = None
    group_by: Annotated[
        FoldKey | None,
        Doc("Column that defines the folds. Default: the list's."),
    ] = None
    folds: Annotated[
        int | str | None,
        Doc(
            "Number of folds, or each: every drive (or value of `group_by`) is a fold. Default: "
            "the list's."
        ),
    ] = None
    ranking: Annotated[
        str | None,
        Doc(f"Rank the inputs of `order` first: {', '.join(RANKINGS)}. Default: declared."),
    ] = None
    criterion: Annotated[
        str | None,
        Doc(
            "Criterion for the number of ranked inputs: cv (the smallest model that is negligibly "
            f"worse than the best; see `tolerance`), {', '.join(CRITERIA)}. Default: cv."
        ),
    ] = None
    tolerance: Annotated[str | None, TOLERANCE] = None
    all_subsets: Annotated[
        bool, Doc("Search all subsets of the inputs of `order` instead of nested models.")
    ] = False
    robust: Annotated[
        bool,
        Doc(
            "Down-weight outlier drives (error above three times the median). Lists them; see "
            "diagnose."
        ),
    ] = False
    cluster: Annotated[ClusterUnit | None, CLUSTER] = None
    intercept: Annotated[
        bool,
        Doc(
            "Fit an intercept. Without it a car that drives straight has no side-slip, and no "
            "sensor an offset."
        ),
    ] = True
    search: Annotated[
        str | None,
        Doc(
            f"Search among the inputs of `order`, or all: {', '.join(METHODS)}. Every fold repeats "
            "the search. Adds its models of 1, 2, ... columns."
        ),
    ] = None
    max_features: Annotated[
        int | None,
        Doc(f"Maximum number of columns of `search`. Default: {DEFAULT_MAX_FEATURES}."),
    ] = None
    half_life: Annotated[
        int | None,
        Doc(
            "Age in days, before the cohort's newest day, at which the weight of a drive is halved."
        ),
    ] = None
    prior: Annotated[
        str | None,
        Doc(
            "Campaign of configs/campaigns, or a TOML file, whose simulated drives join the "
            "training unless held-out drives are worse with them: fleet-slip identify --campaign."
        ),
    ] = None

    @property
    def is_ordered(self) -> bool:
        """True if inputs are ranked, or all subsets searched, instead of comparing a list."""
        return bool(self.ranking or self.criterion or self.all_subsets)

    @property
    def has_inputs(self) -> bool:
        """True if the options themselves define the models, so that no list is needed."""
        return bool(self.model or self.order or self.is_ordered or self.search)

    def check(self) -> None:
        """Raise `UsageError` for options that exclude each other."""
        parse_tolerance(self.tolerance)
        ranks_order = self.is_ordered or bool(self.order and not self.search)
        conflicts = (
            (
                self.is_ordered and self.models,
                "a list of models is compared by cross-validation: leave out models, or ranking, "
                "criterion and all_subsets, which search among the inputs of order.",
            ),
            (
                self.model and (self.models or self.order or self.is_ordered or self.search),
                "model names the inputs: leave out models, order, ranking, criterion, all_subsets "
                "and search, or leave out model.",
            ),
            (
                self.ranking and self.all_subsets,
                "a search of all subsets needs no ranking: leave out ranking.",
            ),
            (
                self.max_features and not self.search,
                "max_features limits a search: add search, or leave it out.",
            ),
            (
                self.cluster and not (self.is_ordered or self.order),
                "cluster applies to order, ranking, criterion and all_subsets: leave it out.",
            ),
            (
                self.prior and (self.label or ranks_order),
                "a prior works with a model list, one model or a search: leave out label, ranking, "
                "criterion, all_subsets, and order without search.",
            ),
            (
                self.half_life is not None and self.half_life < 1,
                "half_life: give a whole number of days, at least 1.",
            ),
            (
                self.search and self.is_ordered,
                "a search is repeated in every fold and judged by folds alone: leave out ranking, "
                "criterion and all_subsets.",
            ),
        )
        for applies, message in conflicts:
            if applies:
                raise UsageError(message)


def parse_tolerance(text: str | None) -> Tolerance:
    """Return a tolerance from text such as `0.025deg` or `2%`. Raises `UsageError`."""
    if text is None:
        return DEFAULT_TOLERANCE
    match = _TOLERANCE.fullmatch(text.strip())
    if match is None:
        raise UsageError(
            f"tolerance = {text}: write an angle such as 0.025deg, or a share of the best RMSE "
            "such as 2%."
        )
    amount = float(match[1])
    return (
        Tolerance(amount / 100, relative=True)
        if match[2] == "%"
        else Tolerance(math.radians(amount))
    )


# Model lists: the candidates that a selection compares, read from `configs/models/*.toml`.

MAX_LISTED_INPUTS = 30
"""Maximum number of inputs, or families of them, in a message."""


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


RENAMED_KEYS = {
    "most": "max_features",
    "fewest_drives": "min_drives",
    "columns_per_drive": "max_features_per_drive",
}
"""Keys of `Search`. Checksums and documents of versions keep the old names."""


class Search(Config):
    """A search among many inputs for at most `max_features` columns.

    The `rule` chooses the size: `best` has the best cross-validated correlation; `tolerance` the
    fewest columns with a negligibly larger error (`fleet_slip.regression.choice`); `standard error`
    the fewest with an error that is larger by at most one standard error over folds. A search needs
    `min_drives`, and takes at most `max_features_per_drive` unless folds are parts of drives.
    """

    name: str | None = Field(default=None, min_length=1, max_length=40)
    """Prefix of the names of its models. Default: the method."""
    inputs: Members | None = None
    """Columns to search among; a family stands for its members. Default: the feature set's."""
    method: Literal["forward", "backward", "exchange"] = "forward"
    max_features: int = Field(
        default=DEFAULT_MAX_FEATURES, ge=1, le=200, serialization_alias="most"
    )
    rule: Literal["best", "tolerance", "standard error"] = "tolerance"
    min_drives: int = Field(default=0, ge=0, serialization_alias="fewest_drives")
    max_features_per_drive: int | None = Field(
        default=None, ge=1, serialization_alias="columns_per_drive"
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_renamed(cls, content: Any) -> Any:
        if isinstance(content, dict) and content.get("rule") == "worth":
            raise ValueError('rule = "worth" is now called "tolerance": rename it')
        return refuse_renamed(content, RENAMED_KEYS)

    @property
    def title(self) -> str:
        """The name, or else the method."""
        return self.name or self.method

    def as_dict(self, **options: Any) -> dict[str, Any]:
        """Return the content under the names of documents; see `RENAMED_KEYS`."""
        content = self.model_dump(mode="json", by_alias=True, **options)
        return content | ({"rule": "worth"} if content.get("rule") == "tolerance" else {})

    def among(self, inputs: Sequence[str]) -> tuple[str, ...]:
        """Return the inputs of a cohort that are searched."""
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
        dumped = [each.as_dict(exclude_defaults=True) for each in search]
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
    more = f" and {len(names) - MAX_LISTED_INPUTS} more (fleet-slip features)"
    return ", ".join(names[:MAX_LISTED_INPUTS]) + (more if len(names) > MAX_LISTED_INPUTS else "")
