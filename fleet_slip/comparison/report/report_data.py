"""Everything that a report shows, gathered from warehouse, registry and evaluation."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.comparison.evaluation.estimators import (
    TABLE_ONE,
    Estimate,
    LinearEstimate,
    TrainedModels,
    published_estimate,
    train_models,
)
from fleet_slip.comparison.evaluation.filters import rebuild
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario, run_all
from fleet_slip.comparison.evaluation.targets import THE_PAPERS_CHOICE
from fleet_slip.comparison.report.fleet_cars import Cars, weigh_cars
from fleet_slip.comparison.report.kept_evaluation import Evaluated, latest_of, latest_on_measured
from fleet_slip.comparison.report.training_findings import (
    Coefficients,
    Ordering,
    coefficient_table,
    compare_orders,
    lateral_reach_mps2,
)
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.cohorts.folding import BANDS, Folding
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.regression.choice.nested_choice import NestedDistances
from fleet_slip.regression.validation.crossval import CrossValidation
from fleet_slip.resources import config_file
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.selection.request import SelectionRequest
from fleet_slip.selection.search import try_distances
from fleet_slip.selection.select_models import Selection, select
from fleet_slip.simulation.scenario import Scenario, load_scenario, shipped_scenarios
from fleet_slip.warehouse.tables import Warehouse

DRAWN_FILTERS = ("kalman", "kalman_tuned")
DRAWN_SCENARIOS = (
    "nominal",
    "noise_doubled",
    "mass_1000",
    "mass_1740",
    "adhesion_0_7",
    "adhesion_0_4",
    "melbourne",
    "gps_tunnel",
    "style_gentle",
    "style_brisk",
    "style_sporty",
    "style_limit",
)
TRAINED_SHARE = 0.999

MOST_TERMS = 60
"""Of a larger model no standard errors are shown: hundreds of rows tell nothing."""


@dataclass(frozen=True)
class ReportData:
    """All that a report shows.

    Attributes:
        version: the model version that it is about.
        evaluated: its latest evaluation.
        trained: its cohort, and the models of Table I on it.
        runs: drives of the evaluation's scenarios with the estimates that figures show.
        coefficients: of the paper's choice, then of the published model if it is another and small.
        trained_to_mps2: the lateral acceleration that `TRAINED_SHARE` of the training rows stay
            below.
        ordering: what the order of the signals is worth.
        by_speed: the models of Table I with whole bands of speed left out, by name; empty where all
            drives are of one speed.
        distances: of the nested models of all signals in their declared order, or why there are
            none.
        cars: what a car's own numbers are worth; None without a fleet in the data root.
        on_measured: its latest evaluation on measured drives; None if there is none.
        campaigns: of the drives that the model was trained on.
        configs: checksums of what determines the results, by file.
        shipped: names of all shipped scenarios, evaluated or not.
    """

    version: ModelVersion
    evaluated: Evaluated
    trained: TrainedModels
    runs: Mapping[str, EvaluatedScenario]
    coefficients: tuple[Coefficients, ...]
    trained_to_mps2: float
    ordering: Ordering
    by_speed: Mapping[str, CrossValidation]
    distances: NestedDistances | str
    cars: Cars | None
    on_measured: Mapping[str, Any] | None
    campaigns: tuple[str, ...]
    configs: Mapping[str, str]
    shipped: tuple[str, ...]

    @property
    def choice(self) -> str:
        """Estimator's name of the model that the paper settles on."""
        return self.evaluated.models[self.choice_number]

    @property
    def choice_number(self) -> str:
        """Its number in Table I; of the last that the training drives have the signals for."""
        return _choose(list(self.evaluated.models))


def _choose(names: Sequence[str]) -> str:
    """Return the paper's choice, or the last model where the drives lack signals of that."""
    return THE_PAPERS_CHOICE if THE_PAPERS_CHOICE in names else names[-1]


def _paper_choice(models: Sequence[CrossValidation]) -> CrossValidation:
    chosen = _choose([model.name for model in models])
    return next(model for model in models if model.name == chosen)


def gather(warehouse: Warehouse, version: ModelVersion) -> ReportData:
    """Gather a report about a model version.

    Raises `DataError` if the version has not been evaluated, or if its cohort or a drive of a
    scenario has changed since: all numbers of a report must be of the same data.
    """
    evaluated = latest_of(warehouse, version)
    trained = train_models(warehouse, version)
    evaluated.require_models(trained)
    shipped = shipped_scenarios()
    scenarios = [one for one in shipped if one.name in evaluated.scenarios]
    drawn = [one for one in scenarios if one.name in DRAWN_SCENARIOS]
    runs = {
        run.scenario.name: run
        for run in run_all(warehouse, drawn, drawn_estimators(evaluated, version))
    }
    evaluated.require_figures(runs)
    cohort, models = trained.selection.cohort, trained.selection.models
    own = _own_cohort(warehouse, trained)
    signals = tuple(dict.fromkeys(models[-1].signals))
    signals_toml = config_file("signals.toml").read_bytes()
    return ReportData(
        version=version,
        evaluated=evaluated,
        trained=trained,
        runs=runs,
        coefficients=_coefficients(trained, own),
        trained_to_mps2=lateral_reach_mps2(warehouse, cohort, TRAINED_SHARE),
        ordering=compare_orders(cohort, signals),
        by_speed=_by_speed(trained.selection),
        distances=try_distances(cohort, signals, trained.selection.folds, SelectionRequest()),
        cars=weigh_cars(warehouse),
        on_measured=latest_on_measured(warehouse, version),
        campaigns=tuple(sorted(set(cohort.drives["campaign"].to_pylist()))),
        configs={
            "configs/signals.toml": hashlib.sha256(signals_toml).hexdigest(),
            f"configs/models/{TABLE_ONE}.toml": load_model_list(TABLE_ONE).sha256,
            **{f"configs/scenarios/{one.name}.toml": _checksum_of(one) for one in scenarios},
        },
        shipped=tuple(one.name for one in shipped),
    )


def drawn_estimators(evaluated: Evaluated, version: ModelVersion) -> dict[str, Estimate]:
    """Return the estimators that figures show, rebuilt from what the evaluation says of them."""
    car = load_scenario("nominal").car
    estimators: dict[str, Estimate] = {}
    for name in evaluated.models.values():
        about = evaluated.estimators[name]
        estimators[name] = LinearEstimate(about["intercept"], about["coefficients"])
    for name in DRAWN_FILTERS:
        if name in evaluated.estimators:
            estimators[name] = rebuild(name, evaluated.estimators[name], car)
    return estimators | {version.reference: published_estimate(version.manifest)}


def _by_speed(selection: Selection) -> dict[str, CrossValidation]:
    """Return the same models with as many whole bands of speed left out, one after another."""
    bands = Folding(by=BANDS, count=selection.folds.count)
    try:
        found = select(selection.cohort, load_model_list(TABLE_ONE).model, bands)
    except (DataError, QuestionError):
        return {}
    return {model.name: model for model in found.models}


def _own_cohort(warehouse: Warehouse, trained: TrainedModels) -> Cohort:
    """Return the cohort with the Gram rows that the published model was made of."""
    cohort = trained.selection.cohort
    name = features().name_of(trained.version.manifest.trained_on.feature_set)
    return cohort if name == PLAIN else load_cohort(warehouse, cohort.condition, name)


def _coefficients(trained: TrainedModels, own: Cohort) -> tuple[Coefficients, ...]:
    cohort, published = trained.selection.cohort, trained.version
    choice = _paper_choice(trained.selection.models)
    tables = [coefficient_table(cohort, f"model {choice.name}", choice.signals)]
    signals = published.manifest.signals
    if set(signals) != set(choice.signals) and len(signals) <= MOST_TERMS:
        intercept = not published.manifest.through_origin
        tables.append(coefficient_table(own, published.reference, signals, intercept=intercept))
    return tuple(tables)


def _checksum_of(scenario: Scenario) -> str:
    """Return the checksum of all that determines a scenario's drive, and of its failures."""
    failures = [failure.model_dump(mode="json") for failure in scenario.failures]
    return sha256_of(canonical_json({"drive": scenario.batch().digest, "failures": failures}))
