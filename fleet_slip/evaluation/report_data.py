"""Everything that a report shows, gathered from warehouse, registry and evaluation."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from fleet_slip.base import FloatArray, canonical_json, sha256_of
from fleet_slip.catalogue.features import PLAIN, features
from fleet_slip.config import config_file
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.evaluation.evaluate import evaluations_of
from fleet_slip.evaluation.filters import (
    TABLE_ONE,
    Estimate,
    LinearEstimate,
    TrainedModels,
    published_estimate,
    rebuild,
    train_models,
)
from fleet_slip.evaluation.fleet_cars import Cars, weigh_cars
from fleet_slip.evaluation.own_car import own_car_evaluations
from fleet_slip.evaluation.scenarios import (
    THE_PAPERS_CHOICE,
    ErrorFigures,
    EvaluatedScenario,
    run_all,
)
from fleet_slip.evaluation.training_findings import (
    Coefficients,
    Ordering,
    coefficient_table,
    compare_orders,
    lateral_reach_mps2,
)
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.folding import BANDS, Folding
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.request import SelectionRequest, load_model_list
from fleet_slip.models.search import try_distances
from fleet_slip.models.select import Selection, select
from fleet_slip.regression.choice import NestedDistances
from fleet_slip.regression.figures import student_t_two_sided
from fleet_slip.regression.folds import CrossValidation
from fleet_slip.simulation.scenario import Scenario, load_scenario, shipped_scenarios
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.storage.documents import Document
from fleet_slip.warehouse.tables import Warehouse

# A kept evaluation, read back, and its estimators compared stretch by stretch of a drive.

Side = Literal["inside", "outside"]


@dataclass(frozen=True)
class Evaluated:
    """An evaluation as it was kept, and the model version `NAME@VERSION` that it is about."""

    document: Document
    group: str

    @property
    def estimators(self) -> Mapping[str, Mapping[str, Any]]:
        """What the document says of each estimator, by name."""
        estimators: Mapping[str, Mapping[str, Any]] = self.document.content["estimators"]
        return estimators

    @cached_property
    def scenarios(self) -> Mapping[str, Mapping[str, Any]]:
        """What the document says of each scenario, by name, in its order."""
        return {one["name"]: one for one in self.document.content["scenarios"]}

    def rows(self, key: Literal["checks", "comparisons"]) -> Sequence[Mapping[str, Any]]:
        """Return one of the document's lists."""
        rows: Sequence[Mapping[str, Any]] = self.document.content[key]
        return rows

    @property
    def gps_noise(self) -> Mapping[str, Any] | None:
        """The filters' errors over the noise of GPS; None in evaluations without it."""
        sweep: Mapping[str, Any] | None = self.document.content.get("gps_noise")
        return sweep

    @cached_property
    def models(self) -> Mapping[str, str]:
        """The estimator's name of each model of Table I that the cohort could serve."""
        return {
            about["table_one"]: name
            for name, about in self.estimators.items()
            if about["group"] == self.group and "table_one" in about
        }

    def of_kind(self, kind: str) -> list[str]:
        """Return the names of the estimators of a kind: regression or filter."""
        return [name for name, about in self.estimators.items() if about["kind"] == kind]

    def figures(self, scenario: str, estimator: str) -> ErrorFigures | None:
        """Return the error figures over a whole drive; None if that was not evaluated."""
        found = self._result(scenario, estimator)
        return None if found is None else _figures(found)

    def part(self, scenario: str, estimator: str, side: Side, section: str) -> ErrorFigures | None:
        """Return the error figures inside or outside of a section; None if there is none."""
        found = self._result(scenario, estimator)
        if found is None or section not in found[side]:
            return None
        return _figures(found[side][section])

    def stretches(self, scenario: str, section: str) -> list[tuple[float, float]]:
        """Return begin and end in s of the stretches of a section; none if there is no such."""
        sections = self.scenarios[scenario]["sections"] if scenario in self.scenarios else []
        return [
            (stretch["from_s"], stretch["until_s"])
            for found in sections
            if found["name"] == section
            for stretch in found["stretches"]
        ]

    def require_models(self, trained: TrainedModels) -> None:
        """Raise `DataError` if today's data make others of the models of Table I."""
        now = {name: model.as_dict() for name, model in trained.estimators().items()}
        for name in self.models.values():
            kept = self.estimators[name]
            if name not in now or now[name] != {key: kept.get(key) for key in now[name]}:
                raise self._changed(f"the cohort of {self.group}")

    def require_figures(self, runs: Mapping[str, EvaluatedScenario]) -> None:
        """Raise `DataError` if an estimator is off by more or less on a drive of today."""
        for scenario, run in runs.items():
            for name, result in run.results.items():
                kept = self.figures(scenario, name)
                if kept is None or not _same(kept.rmse_deg, result.whole.rmse_deg):
                    raise self._changed(f"the drive of {scenario}, or {name},")

    def _changed(self, what: str) -> DataError:
        return DataError(
            f"{what} has changed since evaluation {self.document.number}. Run: fleet-slip "
            f"evaluate {self.group}"
        )

    def _result(self, scenario: str, estimator: str) -> Mapping[str, Any] | None:
        if scenario not in self.scenarios:
            return None
        result: Mapping[str, Any] | None = self.scenarios[scenario]["results"].get(estimator)
        return result


SAME = 1e-6
"""Relative difference below which two figures of the same estimates are the same."""


def _same(first: float | None, second: float | None) -> bool:
    if first is None or second is None:
        return first is second
    return math.isclose(first, second, rel_tol=SAME)


def _figures(found: Mapping[str, Any]) -> ErrorFigures:
    return ErrorFigures(**{name: found[name] for name in ErrorFigures.__dataclass_fields__})


def latest_of(warehouse: Warehouse, version: ModelVersion) -> Evaluated:
    """Return the latest evaluation about a model version. Raises `DataError` if there is none."""
    kept = evaluations_of(warehouse)
    for number in reversed(kept.numbers()):
        document = kept.read(number)
        first = next(iter(document.content["estimators"].values()))
        if first["group"] == version.reference:
            return Evaluated(document, version.reference)
    raise DataError(
        f"{version.reference} has not been evaluated. Run: fleet-slip evaluate {version.reference}"
    )


def latest_on_measured(warehouse: Warehouse, version: ModelVersion) -> Mapping[str, Any] | None:
    """Return the latest evaluation of a version on measured drives; None if there is none."""
    kept = own_car_evaluations(warehouse)
    documents = (kept.read(number).content for number in reversed(kept.numbers()))
    return next((one for one in documents if one["model"] == version.reference), None)


BLOCK_S = 5.0
"""Errors of neighbouring samples depend on each other; over this time they nearly do not."""


@dataclass(frozen=True)
class ErrorDifference:
    """A paired t test of squared errors over blocks; t > 0 where the first is better."""

    t: float
    blocks: int
    p: float


def mean_squares(run: EvaluatedScenario, estimator: str) -> FloatArray:
    """Return the mean squared error in deg² of each block of a drive, shape (blocks,)."""
    error = np.degrees(run.estimates[estimator] - run.drive.sideslip_rad)[run.drive.evaluated]
    size = int(BLOCK_S * SAMPLE_RATE_HZ)
    whole = len(error) // size
    squares: FloatArray = (error[: whole * size].reshape(whole, size) ** 2).mean(axis=1)
    return squares


def difference(run: EvaluatedScenario, first: str, second: str) -> ErrorDifference:
    """Compare the squared errors of two estimators by a paired t test over blocks."""
    gain = mean_squares(run, second) - mean_squares(run, first)
    t = float(gain.mean() / (gain.std(ddof=1) / math.sqrt(len(gain))))
    return ErrorDifference(t, len(gain), student_t_two_sided(t, len(gain) - 1))


def blocks_won(run: EvaluatedScenario, estimators: Sequence[str]) -> dict[str, int]:
    """Return in how many blocks of a drive each estimator has the smallest squared error."""
    squares = np.stack([mean_squares(run, name) for name in estimators])
    best = np.bincount(squares.argmin(axis=0), minlength=len(estimators))
    return dict(zip(estimators, best.tolist(), strict=True))


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
