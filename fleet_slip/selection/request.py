"""What to select, as it is asked for on the command line, and its execution."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import QuestionError, UsageError
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.fold_sums import SummedCohort, sum_cohort
from fleet_slip.grams.folding import EACH, ROW_FOLDS, Folding, FoldKey, make_folding
from fleet_slip.regression.drive_moments import ClusterUnit
from fleet_slip.regression.nested_choice import Rule
from fleet_slip.regression.stepwise import METHODS
from fleet_slip.selection.compare import Selection, select
from fleet_slip.selection.model_list import (
    CandidateModel,
    ModelList,
    Search,
    load_model_list,
    nested_candidates,
)
from fleet_slip.selection.search import require_criterion, select_ranked, select_subsets
from fleet_slip.selection.uncertainty import estimate_uncertainty
from fleet_slip.selection.worth import WORTH, parse_worth
from fleet_slip.warehouse.tables import Warehouse

DEFAULT_MODELS = "table1"

GIVEN = "given"
"""The name of a model whose inputs were asked for one by one."""

WHOLE_SET = "catalogue"
"""As an order of signals: all inputs of the feature set, in its order."""


@dataclass(frozen=True, kw_only=True)
class SelectionRequest:
    """What to select.

    Attributes:
        cohort: SQL condition on the view `drives`.
        models: name or path of a model list; by default `table1`, unless signals are named.
        model: inputs of the one model to take, separated by commas, instead of a list.
        nested: order of inputs, separated by commas, or `catalogue`; adds its nested models.
        features: name of the feature set; by default what the list says, or what the folds need.
        by, folds: how to fold; by default what the list says.
        rank, criterion: rank the inputs of `nested` first; choose by a criterion.
        all_subsets: choose among the best subsets of `nested` instead of an order's.
        worth: gain in RMSE for which cross-validation keeps a signal, such as `0.005deg` or `2%`.
        naive: take rows for independent instead of drives or cars.
        cluster: what is independent; by default cars where there are several, else drives.
        search, most: search among the inputs of `nested`, or all, for models of up to so many.
        bootstrap, repeat: how often to resample the winner's figures.
    """

    cohort: str = TRAINING_DRIVES
    models: str | None = None
    model: str | None = None
    nested: str | None = None
    features: str | None = None
    by: FoldKey | None = None
    folds: int | str | None = None
    rank: str | None = None
    criterion: str | None = None
    worth: str = WORTH
    all_subsets: bool = False
    naive: bool = False
    cluster: ClusterUnit | None = None
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


@dataclass(frozen=True, kw_only=True)
class RequestedSelection(Selection[Any]):
    """A selection that can be published: it tells what it was made from.

    Attributes:
        model_list: what was compared, such as `table1`.
        config_sha256: checksum of all that says what to compare.
    """

    model_list: str
    config_sha256: str

    @classmethod
    def of(
        cls, selection: Selection[Any], model_list: str, config_sha256: str
    ) -> "RequestedSelection":
        """Return a selection with what it was made from."""
        return cls(**vars(selection), model_list=model_list, config_sha256=config_sha256)


def answer_request(warehouse: Warehouse, request: SelectionRequest) -> RequestedSelection:
    """Select as asked. Raises `UsageError` for options that do not go together."""
    parse_worth(request.worth)  # before anything is read
    if request.ordered and request.models:
        raise UsageError(
            "a list of models is compared by cross-validation as it stands: leave out models, or "
            "rank, criterion, all_subsets and naive, which search among the inputs of nested."
        )
    if request.model and (request.models or request.nested or request.ordered or request.search):
        raise UsageError(
            "model says which inputs to take: leave it out, or models, nested, rank, criterion, "
            "all_subsets, naive and search, which choose."
        )
    if request.rank and request.all_subsets:
        raise UsageError("a search of all subsets needs no order: leave out rank.")
    if request.most and not request.search:
        raise UsageError("most is for a search: say how to search.")
    if request.cluster and (request.naive or not (request.ordered or request.bootstrap)):
        raise UsageError(
            "cluster says what is independent evidence for rank, criterion, all_subsets and "
            "bootstrap: leave it out, or naive."
        )
    if request.search and request.ordered:
        raise UsageError(
            "a search is made again in every fold, and looks at folds alone: leave out rank, "
            "criterion, all_subsets and naive."
        )
    named = request.nested or request.ordered or request.search
    name = request.models or (None if named else DEFAULT_MODELS)
    model_list = _given(request) or (load_model_list(name) if name else None)
    folds = _folding(request, model_list)
    feature_set = _feature_set(request, model_list)
    if not request.ordered and not request.resampled:
        return _compare_listed(
            sum_cohort(warehouse, folds, request.cohort, feature_set), request, model_list, folds
        )
    cohort = load_cohort(warehouse, request.cohort, feature_set)
    answer = (
        _search(cohort, request, folds)
        if request.ordered
        else _compare_listed(cohort, request, model_list, folds)
    )
    if not request.resampled:
        return answer
    figures = estimate_uncertainty(
        cohort,
        answer.winner.model,
        folds,
        bootstrap=request.bootstrap,
        repeat=request.repeat,
        cluster=request.cluster,
    )
    return replace(answer, uncertainty=figures)


def _given(request: SelectionRequest) -> ModelList | None:
    """Return the one model that was asked for, if there is one, as a list."""
    if request.model is None:
        return None
    feature_set = request.features or PLAIN
    signals = require_inputs(request.model.split(","), feature_set)
    model = CandidateModel(name=GIVEN, signals=signals)
    return ModelList(description="One model", features=feature_set, model=(model,))


def _folding(request: SelectionRequest, model_list: ModelList | None) -> Folding:
    listed = model_list.folds if model_list else Folding()
    folding = make_folding(request.by or listed.by, request.folds, listed.count)
    if request.repeat and folding.count == EACH:
        raise UsageError("repeat deals the folds anew, and folds of each drive have one deal only.")
    return folding


def _feature_set(request: SelectionRequest, model_list: ModelList | None) -> str:
    named = request.features or (model_list.features if model_list else PLAIN)
    if request.by == ROW_FOLDS and named == PLAIN:
        return next(name for name, one in features().sets.items() if one.row_folds)
    return named


def _compare_listed(
    cohort: Cohort | SummedCohort,
    request: SelectionRequest,
    model_list: ModelList | None,
    folds: Folding,
) -> RequestedSelection:
    listed = model_list.model if model_list else ()
    search = _search_of(request, model_list)
    inputs = inputs_of(cohort, request.nested or WHOLE_SET) if search else ()
    nested = (
        nested_candidates(inputs_of(cohort, request.nested))
        if request.nested and not search
        else ()
    )
    if search and not listed:
        selection = select(cohort, (), folds, parse_worth(request.worth), search, inputs)
        content = {"inputs": list(inputs), **search.model_dump()}
        label = f"search:{search.method} {search.most}"
        checksum = _checksum(sha256_of(canonical_json(content)), request.worth)
        return RequestedSelection.of(selection, label, checksum)
    described = ModelList(
        description=model_list.description if model_list else "Nested models of an order",
        features=cohort.feature_set,
        folds=folds,
        model=(*listed, *nested),
        search=search,
    )
    usual = GIVEN if request.model else DEFAULT_MODELS
    name = request.models or (usual if listed else None)
    label = "+".join(filter(None, [name, f"nested:{request.nested}" if nested else None]))
    selection = select(cohort, described.model, folds, parse_worth(request.worth), search, inputs)
    return RequestedSelection.of(selection, label, _checksum(described.sha256, request.worth))


def checksum_of_list(model_list: ModelList, worth: str) -> str | None:
    """Return the `config_sha256` of a selection from a list as it stands.

    None for a list that is nothing but a search, whose selection depends on the cohort's inputs.
    """
    return _checksum(model_list.sha256, worth) if model_list.model else None


def _checksum(compared: str, worth: str) -> str:
    """Return the checksum of what is compared, and of the worth if it is not the usual one."""
    if parse_worth(worth) == parse_worth(WORTH):
        return compared
    return sha256_of(canonical_json({"compared": compared, "worth": worth}))


def _search_of(request: SelectionRequest, model_list: ModelList | None) -> Search | None:
    """Return how to search: as asked for, else as the list says, if at all."""
    if request.search:
        if request.search not in METHODS:
            raise QuestionError(f"unknown search {request.search!r}. Known: {', '.join(METHODS)}.")
        asked = {"method": request.search, **({"most": request.most} if request.most else {})}
        return Search.model_validate(asked)
    return model_list.search if model_list else None


def _search(cohort: Cohort, request: SelectionRequest, folds: Folding) -> RequestedSelection:
    nested = request.nested or WHOLE_SET
    inputs = inputs_of(cohort, nested)
    criterion = require_criterion(request.criterion or "cv")
    rule = Rule(request.rank or "declared", criterion, parse_worth(request.worth))
    choose = select_subsets if request.all_subsets else select_ranked
    found = choose(cohort, inputs, folds, rule, naive=request.naive, cluster=request.cluster)
    rule = found.choice.rule
    described = ModelList(
        description="Inputs to choose from",
        features=cohort.feature_set,
        folds=folds,
        model=(CandidateModel(name="inputs", signals=inputs),),
    )
    content = {"inputs": described.sha256, "ranking": rule.ranking, "criterion": rule.criterion}
    content |= {"evidence": found.choice.evidence.kind}
    return RequestedSelection.of(
        Selection(cohort, folds, found.models, found.winner, {}, choice=found.choice),
        f"nested:{nested} {rule.ranking} {rule.criterion}",
        sha256_of(canonical_json(content)),
    )


def inputs_of(cohort: Cohort | SummedCohort, order: str) -> tuple[str, ...]:
    """Return an order of inputs from text, `catalogue` meaning all that the cohort has.

    Raises what `require_inputs` raises.
    """
    if order == WHOLE_SET:
        return cohort.inputs
    return require_inputs(order.split(","), cohort.feature_set)


def require_inputs(names: Sequence[str], feature_set: str) -> tuple[str, ...]:
    """Return the names of inputs of a feature set.

    Raises `QuestionError` for an unknown input, and `UsageError` for one that stands twice.
    """
    known = features().feature_set(feature_set).inputs
    order = tuple(name.strip() for name in names)
    if unknown := [name for name in order if name not in known]:
        raise QuestionError(
            f"{','.join(order)}: {', '.join(unknown)} is not an input. Inputs of the feature set "
            f"{feature_set}: {', '.join(known)}."
        )
    if len(set(order)) < len(order):
        raise UsageError(f"{','.join(order)}: an input stands twice.")
    return order
