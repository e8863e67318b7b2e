"""An evaluation from end to end: models, scenarios, figures, checks and comparisons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fleet_slip.evaluation.comparison import Comparison, compare
from fleet_slip.evaluation.estimators import Estimate, training
from fleet_slip.evaluation.results import document
from fleet_slip.evaluation.runs import Run, run_all
from fleet_slip.evaluation.targets import Check, checks
from fleet_slip.registry import ModelVersion
from fleet_slip.scenario import Scenario
from fleet_slip.warehouse import Warehouse


@dataclass(frozen=True)
class Evaluation:
    """Everything that an evaluation found, with the drives and estimates behind it."""

    runs: tuple[Run, ...]
    descriptions: Mapping[str, Mapping[str, Any]]
    checks: tuple[Check, ...]
    comparisons: tuple[Comparison, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the evaluation's document."""
        return document(
            self.runs,
            self.descriptions,
            checks=[check.as_dict() for check in self.checks],
            comparisons=[comparison.as_dict() for comparison in self.comparisons],
        )


def evaluate(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario],
    one_car: ModelVersion,
    fleets: Sequence[ModelVersion] = (),
) -> Evaluation:
    """Evaluate a model, and others to compare it with, on scenarios that are in the logs."""
    first, *others = [training(warehouse, version) for version in (one_car, *fleets)]
    estimators: dict[str, Estimate] = {}
    descriptions: dict[str, Mapping[str, Any]] = {}
    for trained in (first, *others):
        estimators |= trained.estimators()
        descriptions |= trained.descriptions()
    runs = run_all(warehouse, scenarios, estimators)
    return Evaluation(
        runs=runs,
        descriptions=descriptions,
        checks=checks(runs, first.table_one, first.estimators()),
        comparisons=tuple(row for fleet in others for row in compare(runs, first, fleet)),
    )
