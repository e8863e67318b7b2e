"""What to select, as it is asked for on the command line, and its execution."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.features import PLAIN, features
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.errors import ConfigError
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.fold_sums import SummedCohort, sum_cohort
from fleet_slip.grams.folding import ROW_FOLDS, Folding, FoldKey
from fleet_slip.regression.nested_choice import Rule
from fleet_slip.selection.compare import Selection, select
from fleet_slip.selection.model_list import (
    CandidateModel,
    ModelList,
    load_model_list,
    nested_models,
)
from fleet_slip.selection.search import check_criterion, select_ranked, select_subsets
from fleet_slip.selection.uncertainty import uncertainty
from fleet_slip.warehouse.tables import Warehouse

DEFAULT_MODELS = "table1"

WHOLE_SET = "catalogue"
"""As an order of signals: all inputs of the feature set, in its order."""


@dataclass(frozen=True)
class SelectionPlan:
    """What to select.

    Attributes:
        cohort: SQL condition on the view `drives`.
        models: name or path of a model list; by default `table1`, unless signals are named.
        nested: order of inputs, separated by commas, or `catalogue`; adds its nested models.
        features: name of the feature set; by default what the list says, or what the folds need.
        by, folds: how to fold; by default what the list says.
        rank, criterion: rank the inputs of `nested` first; choose by a criterion.
        all_subsets: choose among the best subsets of `nested` instead of an order's.
        naive: take rows for independent instead of drives.
        bootstrap, repeat: how often to resample the winner's figures.
    """

    cohort: str = TRAINING_DRIVES
    models: str | None = None
    nested: str | None = None
    features: str | None = None
    by: FoldKey | None = None
    folds: int | None = None
    rank: str | None = None
    criterion: str | None = None
    all_subsets: bool = False
    naive: bool = False
    bootstrap: int | None = None
    repeat: int | None = None

    @property
    def ordered(self) -> bool:
        """Whether inputs are ranked or searched, rather than given models compared."""
        return bool(self.rank or self.criterion or self.all_subsets or self.naive)

    @property
    def resampled(self) -> bool:
        """Whether the winner's figures are resampled."""
        return bool(self.bootstrap or self.repeat)


@dataclass(frozen=True)
class PlannedSelection:
    """A selection, what it was made from, and a checksum of that."""

    selection: Selection[Any]
    label: str
    config_sha256: str


def run_plan(warehouse: Warehouse, plan: SelectionPlan) -> PlannedSelection:
    """Select as planned. Raises `ConfigError` for options that do not go together."""
    if plan.ordered and plan.models:
        raise ConfigError(
            "a list of models is compared by cross-validation as it stands: leave out --models, or "
            "--rank, --criterion, --all-subsets and --naive, which search among the inputs of "
            "--nested."
        )
    if plan.rank and plan.all_subsets:
        raise ConfigError("--all-subsets needs no order: leave out --rank.")
    name = plan.models or (None if plan.nested or plan.ordered else DEFAULT_MODELS)
    model_list = load_model_list(name) if name else None
    folds = _fold_plan(plan, model_list)
    feature_set = _feature_set(plan, model_list)
    if not plan.ordered and not plan.resampled:
        return _listed(
            sum_cohort(warehouse, folds, plan.cohort, feature_set), plan, model_list, folds
        )
    cohort = load_cohort(warehouse, plan.cohort, feature_set)
    planned = (
        _ordered(cohort, plan, folds) if plan.ordered else _listed(cohort, plan, model_list, folds)
    )
    if not plan.resampled:
        return planned
    figures = uncertainty(
        cohort, planned.selection.winner.model, folds, bootstrap=plan.bootstrap, repeat=plan.repeat
    )
    return replace(planned, selection=replace(planned.selection, uncertainty=figures))


def _fold_plan(plan: SelectionPlan, model_list: ModelList | None) -> Folding:
    listed = model_list.folds if model_list else Folding()
    return Folding(by=plan.by or listed.by, count=plan.folds or listed.count)


def _feature_set(plan: SelectionPlan, model_list: ModelList | None) -> str:
    named = plan.features or (model_list.features if model_list else PLAIN)
    if plan.by == ROW_FOLDS and named == PLAIN:
        return next(name for name, one in features().sets.items() if one.row_folds)
    return named


def _listed(
    cohort: Cohort | SummedCohort,
    plan: SelectionPlan,
    model_list: ModelList | None,
    folds: Folding,
) -> PlannedSelection:
    listed = model_list.model if model_list else ()
    nested = nested_models(inputs_of(cohort, plan.nested)) if plan.nested else ()
    described = ModelList(
        description=model_list.description if model_list else "Nested models of an order",
        features=cohort.feature_set,
        folds=folds,
        model=(*listed, *nested),
    )
    name = plan.models or (DEFAULT_MODELS if listed else None)
    label = "+".join(filter(None, [name, f"nested:{plan.nested}" if nested else None]))
    return PlannedSelection(select(cohort, described.model, folds), label, described.sha256)


def _ordered(cohort: Cohort, plan: SelectionPlan, folds: Folding) -> PlannedSelection:
    nested = plan.nested or WHOLE_SET
    inputs = inputs_of(cohort, nested)
    rule = Rule(plan.rank or "declared", check_criterion(plan.criterion or "cv"))
    if plan.all_subsets:
        found = select_subsets(cohort, inputs, folds, rule.criterion, naive=plan.naive)
    else:
        found = select_ranked(cohort, inputs, folds, rule, naive=plan.naive)
    rule = found.choice.rule
    described = ModelList(
        description="Inputs to choose from",
        features=cohort.feature_set,
        folds=folds,
        model=(CandidateModel(name="inputs", signals=inputs),),
    )
    content = {"inputs": described.sha256, "ranking": rule.ranking, "criterion": rule.criterion}
    content |= {"evidence": found.choice.evidence.kind}
    return PlannedSelection(
        Selection(cohort, folds, found.models, found.winner, {}, choice=found.choice),
        f"nested:{nested} {rule.ranking} {rule.criterion}",
        sha256_of(canonical_json(content)),
    )


def inputs_of(cohort: Cohort | SummedCohort, order: str) -> tuple[str, ...]:
    """Return an order of inputs from text, `catalogue` meaning all that the cohort has.

    Raises `ConfigError` for an unknown input, or one that stands twice.
    """
    if order == WHOLE_SET:
        return cohort.inputs
    return check_inputs(order.split(","), cohort.feature_set)


def check_inputs(names: Sequence[str], feature_set: str) -> tuple[str, ...]:
    """Return the names of inputs of a feature set. Raises `ConfigError` for what is none."""
    known = features().feature_set(feature_set).inputs
    order = tuple(name.strip() for name in names)
    unknown = [name for name in order if name not in known]
    if unknown or len(set(order)) < len(order):
        raise ConfigError(
            f"{','.join(order)}: {', '.join(unknown) or 'a signal'} "
            f"{'is not an input' if unknown else 'stands twice'}. Inputs of the feature set "
            f"{feature_set}: {', '.join(known)}."
        )
    return order
