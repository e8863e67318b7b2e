"""Options of a selection, for `FleetCohort.select` and `fleet-slip select`, and model lists."""

import difflib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Field,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)

from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config, load_config
from fleet_slip.errors import QuestionError, UsageError
from fleet_slip.grams.cohort import PARTS, Folding, FoldKey, make_folding
from fleet_slip.regression.choice import DEFAULT_TOLERANCE
from fleet_slip.regression.orders import METHODS

if TYPE_CHECKING:
    from fleet_slip.grams.cohort import Cohort

DEFAULT_MODELS = "estimator"
"""The default model list, also of `run` and `nightly`."""

LOGGED_MODELS = "table1"
"""List of logged signals, for other feature sets or if the usual columns are not computed."""

Label = Literal["course"]
"""Substitutes for the label of a reference sensor."""

COURSE_MODELS = COURSE_FEATURES = "course"
"""Default model list and feature set of the label `course`."""

DEFAULT_MAX_FEATURES = 24

_TOLERANCE = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+) ?deg\s*")


@dataclass(frozen=True, kw_only=True)
class SelectionRequest:
    """Options of `FleetCohort.select`, with their defaults.

    Attributes
    ----------
    models
        A model list of `configs/models`, or a TOML file.
    model
        The inputs of one model, separated by commas, instead of a list.
    order
        Inputs, separated by commas, whose first 1, 2, ... form nested models. `catalogue` means all
        inputs; the name of a family means its columns.
    features
        Feature set of `configs/features.toml`. Default: the list's, else the logged signals.
    label
        `course` learns from changes of the course over ground, without a reference sensor.
    group_by
        Key of the folds: `drive`, `vehicle`, `track`, `day`, ... Default: the list's.
    folds
        Number of folds, or `each` for one fold per group. Default: the list's.
    ranking
        Ranking of the inputs of `order`: `declared`, `forward` or `backward`.
    criterion
        Rule for the number of ranked inputs: `cv`, `aic` or `bic`.
    tolerance
        Smallest gain that justifies another signal, an angle such as `0.025deg`.
    robust
        Down-weight outlier drives, with an error above three times the median.
    intercept
        False forces models through the origin.
    search
        Search method among the inputs of `order`, or all, repeated in every fold.
    max_features
        Maximum number of columns of `search`.
    half_life
        Days after which a drive counts half as much.
    prior
        A campaign whose simulated drives join the training with an eighth of the weight of all real
        rows. It is dropped if held-out drives have a clearly larger error with it.
    """

    models: str | None = None
    model: str | None = None
    order: str | None = None
    features: str | None = None
    label: Label | None = None
    group_by: FoldKey | None = None
    folds: int | str | None = None
    ranking: str | None = None
    criterion: str | None = None
    tolerance: str | None = None
    robust: bool = False
    intercept: bool = True
    search: str | None = None
    max_features: int | None = None
    half_life: int | None = None
    prior: str | None = None

    @property
    def is_ordered(self) -> bool:
        """True if inputs are ranked, instead of comparing a list."""
        return bool(self.ranking or self.criterion or (self.order and not self.search))

    def check(self) -> None:
        """Raise `UsageError` for options that exclude each other."""
        parse_tolerance(self.tolerance)
        other_models = self.models or self.is_ordered or self.search
        has_criterion = self.ranking or self.criterion
        is_short = self.half_life is not None and self.half_life < 1
        conflicts = {
            "models are compared by cross-validation: leave out models, or order, ranking and "
            "criterion": self.models and self.is_ordered,
            "model names the inputs: leave out model, or models, order, ranking, criterion and "
            "search": self.model and other_models,
            "a search is judged by folds alone: leave out search, or ranking and criterion": (
                self.search and has_criterion
            ),
            "max_features limits a search: add search": self.max_features and not self.search,
            "a prior works with a model list, one model or a search: leave out label, ranking, "
            "criterion, and order": self.prior and (self.label or self.is_ordered),
            "half_life: give a whole number of days, at least 1": is_short,
        }
        for message, applies in conflicts.items():
            if applies:
                raise UsageError(f"{message}.")


def check_tolerance(text: str) -> str:
    """Return the text of a tolerance. Raises `ValueError` for any other text."""
    if not _TOLERANCE.fullmatch(text):
        raise ValueError("write an angle such as 0.025deg")
    return text


def parse_tolerance(text: str | None) -> float:
    """Return a tolerance in rad from text such as `0.025deg`. Raises `UsageError`."""
    match = _TOLERANCE.fullmatch(text or "")
    if text and not match:
        raise UsageError(f"tolerance = {text}: write an angle such as 0.025deg.")
    return math.radians(float(match[1])) if match else DEFAULT_TOLERANCE


# Model lists: the candidates that a selection compares, read from `configs/models/*.toml`.

MAX_LISTED_INPUTS = 30
"""Maximum number of inputs, or families of them, in a message."""


def expand_families(names: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
    """Replace a family of windows or gates by its members; needs the `Catalog` as context."""
    if not isinstance(catalog := info.context, Catalog):
        return names
    return tuple(member for name in names for member in catalog.members(name))


Members = Annotated[tuple[Identifier, ...], AfterValidator(expand_families)]
"""Names of inputs; in a file, families stand for their members."""


class CandidateModel(Config):
    """A named set of signals or features; a family of windows or gates stands for its members."""

    name: str = Field(min_length=1, max_length=60)
    signals: Annotated[Members, Field(min_length=1)]

    @model_validator(mode="after")
    def _signals_differ(self) -> "CandidateModel":
        if len(set(self.signals)) < len(self.signals):
            raise ValueError(f"model {self.name!r} names a signal twice")
        return self


class Search(Config):
    """A search among many inputs for at most `max_features` columns.

    The `rule` chooses the size. `best`: the best cross-validated correlation. `tolerance`: the
    fewest columns with a negligibly larger error (`fleet_slip.regression.choice`). `standard
    error`: the fewest columns whose error is larger by at most one standard error over folds. A
    search needs `min_drives`, and takes at most `max_features_per_drive` unless folds are parts of
    drives. Aliases are the names in checksums and documents of versions.
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

    @property
    def title(self) -> str:
        """The name, or else the method."""
        return self.name or self.method

    def as_dict(self, **options: Any) -> dict[str, Any]:
        """Return the content under the names of documents."""
        content = self.model_dump(mode="json", by_alias=True, **options)
        return content | ({"rule": "worth"} if content.get("rule") == "tolerance" else {})

    def among(self, inputs: Sequence[str]) -> tuple[str, ...]:
        """Return the inputs of a cohort that are searched."""
        return tuple(name for name in inputs if self.inputs is None or name in self.inputs)


class ModelList(Config):
    """Candidate models, their feature set, and the folds to compare them on.

    A `label` replaces the reference sensor. The models of each `search` join, and the rule of the
    first search chooses unless there is a `tolerance`. A file is validated with the `Catalog` as
    context.
    """

    description: str = Field(min_length=1)
    label: Label | None = None
    features: Identifier = PLAIN
    line: Annotated[str, Field(min_length=1)] | None = None
    """Model list of the first-stage model whose estimate is in the feature set."""
    folds: Folding = Folding()
    tolerance: Annotated[str, AfterValidator(check_tolerance)] | None = None
    intercept: bool = True
    model: tuple[CandidateModel, ...] = ()
    search: tuple[Search, ...] = ()

    @field_validator("search", mode="before")
    @classmethod
    def _as_tuple(cls, search: Any) -> Any:
        return search if isinstance(search, list | tuple) else (search,)

    @field_serializer("search")
    def _as_written(self, search: tuple[Search, ...]) -> Any:
        contents = [entry.as_dict(exclude_defaults=True) for entry in search]
        return contents[0] if len(contents) == 1 else contents  # the checksum of one search

    @model_validator(mode="after")
    def _names_differ(self) -> "ModelList":
        if not (self.model or self.search):
            raise ValueError("there is neither a model nor a search")
        names = [candidate.name for candidate in self.model]
        if len(set(names)) < len(names):
            raise ValueError("two models have the same name")
        return self

    @model_validator(mode="after")
    def _feature_set_has_the_columns(self, info: ValidationInfo) -> "ModelList":
        if not isinstance(catalog := info.context, Catalog):
            return self
        try:
            inputs = catalog.feature_set(self.features).inputs
        except QuestionError as error:
            raise ValueError(f"features: {str(error).rstrip('.')}") from None
        columns = {f"model.{i}.signals": entry.signals for i, entry in enumerate(self.model)}
        columns |= {f"search.{i}.inputs": entry.inputs or () for i, entry in enumerate(self.search)}
        for key, name in ((key, name) for key, names in columns.items() for name in names):
            if name not in inputs:
                similar = " or ".join(difflib.get_close_matches(name, inputs, n=3))
                hint = (
                    f"Did you mean {similar}?"
                    if similar
                    else f"Its inputs: {name_inputs(catalog, inputs)}"
                )
                raise ValueError(
                    f"{key}: {name} is not in the feature set {self.features!r}. {hint}"
                )
        return self

    def absent_from(self, inputs: Sequence[str]) -> list[str]:
        """Return the compared or searched columns that are not among the inputs."""
        columns = [name for candidate in self.model for name in candidate.signals]
        columns += [name for search in self.search for name in search.inputs or ()]
        return [name for name in dict.fromkeys(columns) if name not in inputs]

    @property
    def sha256(self) -> str:
        """Checksum of the content, independent of the layout of a file."""
        content = self.model_dump(mode="json", exclude_defaults=True)
        return sha256_of(canonical_json(content))

    def as_toml(self) -> str:
        """Return the text of a file with this list."""
        excluded = {"folds", "model", "search"}
        lines = _toml_lines("", self.model_dump(exclude_defaults=True, exclude=excluded))
        lines += _toml_lines("[folds]", self.folds.model_dump())
        for candidate in self.model:
            lines += _toml_lines("[[model]]", candidate.model_dump())
        for search in self.search:
            lines += _toml_lines("[[search]]", search.model_dump(exclude_none=True))
        return "\n".join([*lines, ""]).lstrip()


def _toml_lines(head: str, table: Mapping[str, Any]) -> list[str]:
    """Return a table as TOML, which has JSON's texts, numbers and lists."""
    entries = (f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in table.items())
    return ["", head, *entries]


def load_model_list(catalog: Catalog, name_or_path: str) -> ModelList:
    """Return a model list of the catalog's configs, or of a TOML file. Raises `ConfigError`."""
    return load_config(catalog.configs.find("models", name_or_path), ModelList, catalog)


WHOLE_SET = "catalogue"
"""Order of signals that means all inputs of the feature set, in its order."""


def inputs_of(cohort: "Cohort", order: str) -> tuple[str, ...]:
    """Return the inputs that an order names; `catalogue` means all. Raises as `require_inputs`."""
    if order == WHOLE_SET:
        return cohort.inputs
    return require_inputs(cohort.catalog, order.split(","), cohort.feature_set)


def require_inputs(catalog: Catalog, names: Sequence[str], feature_set: str) -> tuple[str, ...]:
    """Return the inputs of some names; a family of windows or gates is replaced by its members.

    Raises `QuestionError` for an unknown input and for an even column of changes, `UsageError` for
    a repeated input.
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
    if reason := even_columns(catalog, order, feature_set):
        raise QuestionError(reason)
    return order


def even_columns(catalog: Catalog, names: Sequence[str], feature_set: str) -> str:
    """Return a sentence that names the columns of changes that are not odd; "" without any.

    An odd column changes its sign if left and right are exchanged.
    """
    has_changes = bool(catalog.feature_set(feature_set).change_ticks)
    even = [name for name in names if has_changes and not catalog.is_odd(name)]
    if not even:
        return ""
    return (
        f"{', '.join(even)}: does not change sign where left and right are exchanged, as the "
        "side-slip angle does: its constant would be wrong. Leave it out."
    )


def name_inputs(catalog: Catalog, inputs: Iterable[str]) -> str:
    """Return the names of inputs or their families for a message, at most `MAX_LISTED_INPUTS`."""
    names = list(catalog.families(inputs))
    more = f" and {len(names) - MAX_LISTED_INPUTS} more (fleet-slip features)"
    return ", ".join(names[:MAX_LISTED_INPUTS]) + (more if len(names) > MAX_LISTED_INPUTS else "")


# The plan: a request that is validated once.

GIVEN = "given"
"""Name of the model that a request defines by its inputs."""


@dataclass(frozen=True)
class SelectionPlan:
    """A validated selection: the candidates, the feature set and the folds.

    Attributes
    ----------
    original
        The request of the user.
    request
        The request with the name of its model list, and the label of the list.
    candidate_list
        The models and searches to compare, with the options of the request; None for an order.
    """

    original: SelectionRequest
    request: SelectionRequest
    candidate_list: ModelList | None
    feature_set: str
    folds: Folding

    @classmethod
    def from_request(cls, catalog: Catalog, original: SelectionRequest) -> "SelectionPlan":
        """Validate a request. Raises `UsageError`, `QuestionError` and `ConfigError`."""
        original.check()
        models = original.models or _default_list(original)
        if models:
            base = load_model_list(catalog, models)
        else:
            description = "One model" if original.model else "Models of a selection"
            default = COURSE_FEATURES if original.label else PLAIN
            base = ModelList.model_construct(description=description, features=default)
        label = original.label or base.label
        request = replace(original, models=models, label=label)
        request.check()
        feature_set = request.features or base.features
        _require_columns(catalog, request, feature_set, base)
        folds = make_folding(request.group_by or base.folds.by, request.folds, base.folds.count)
        if request.is_ordered:
            return cls(original, request, None, feature_set, folds)
        candidates, searches = base.model, base.search
        if request.model:
            signals = require_inputs(catalog, request.model.split(","), feature_set)
            candidates = (CandidateModel(name=GIVEN, signals=signals),)
        if request.search:
            searches = (_search_of(catalog, request, feature_set),)
        changes = {
            "label": label,
            "features": base.features if base.line else feature_set,
            "folds": folds,
            "tolerance": request.tolerance or base.tolerance,
            "intercept": request.intercept and base.intercept,
            "model": candidates,
            "search": searches,
        }
        return cls(original, request, base.model_copy(update=changes), feature_set, folds)


def _default_list(request: SelectionRequest) -> str | None:
    """Return the name of the default list of a request; None if it defines models itself."""
    if request.model or request.is_ordered or request.search:
        return None
    if request.label:
        return COURSE_MODELS
    return LOGGED_MODELS if request.features or request.group_by == PARTS else DEFAULT_MODELS


def _require_columns(
    catalog: Catalog, request: SelectionRequest, name: str, model_list: ModelList
) -> None:
    """Raise `QuestionError` for a feature set without the columns of a request."""
    if request.label and not catalog.feature_set(name).change_ticks:
        names = ", ".join(name for name, entry in catalog.sets.items() if entry.change_s)
        raise QuestionError(
            f"the feature set {name} has no changes of the course. Feature sets that have: {names}."
        )
    inputs = catalog.feature_set(name).inputs
    if absent := model_list.absent_from(inputs):
        raise QuestionError(
            f"the feature set {name} lacks columns of {request.models}: "
            f"{name_inputs(catalog, absent)}. Choose another feature set or model list."
        )


def _search_of(catalog: Catalog, request: SelectionRequest, feature_set: str) -> Search:
    """Return the search of a request. Raises `QuestionError` for an unknown method."""
    if request.search not in METHODS:
        raise QuestionError(f"unknown search {request.search!r}. Known: {', '.join(METHODS)}.")
    inputs = None
    if request.order and request.order != WHOLE_SET:
        inputs = require_inputs(catalog, request.order.split(","), feature_set)
    content = {
        "method": request.search,
        "max_features": request.max_features or DEFAULT_MAX_FEATURES,
        "inputs": inputs,
        # The noise of the course exceeds the gain of a column: compare correlations.
        "rule": "best" if request.label else "tolerance",
    }
    return Search.model_validate(content)


def checksum_of_list(model_list: ModelList) -> str:
    """Return the checksum of a list with its options; options at their default do not count."""
    default = {"label": None, "line": None, "tolerance": None, "intercept": True}
    compared = model_list.model_copy(update=default).sha256
    options: dict[str, Any] = {}
    if model_list.tolerance is not None:
        options["worth"] = model_list.tolerance
    if not model_list.intercept:
        options["intercept"] = False
    return sha256_of(canonical_json({"compared": compared, **options})) if options else compared
