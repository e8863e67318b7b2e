"""A fleet-trained model against the one-car model, scenario by scenario."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fleet_slip.comparison.evaluation.estimators import TrainedModels
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario


@dataclass(frozen=True)
class FleetComparison:
    """Errors of the same set of signals, trained on one car and on a fleet, on one scenario.

    Root mean square errors, because a bias is an error too.
    """

    scenario: str
    model: str
    one_car: str
    fleet: str
    one_car_rmse_deg: float
    fleet_rmse_deg: float

    @property
    def better(self) -> str:
        """Which estimator has the smaller error."""
        return self.one_car if self.one_car_rmse_deg <= self.fleet_rmse_deg else self.fleet

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {**asdict(self), "better": self.better}


def compare_fleets(
    runs: Sequence[EvaluatedScenario], one_car: TrainedModels, fleet: TrainedModels
) -> tuple[FleetComparison, ...]:
    """Compare the models of Table I that both cohorts can serve, wherever both have estimates."""
    found = []
    for run in runs:
        for number, one in one_car.table_one.items():
            other = fleet.table_one.get(number)
            if other is None:
                continue
            errors = [run.results[name].whole.rmse_deg for name in (one, other)]
            if errors[0] is not None and errors[1] is not None:
                found.append(
                    FleetComparison(run.scenario.name, number, one, other, errors[0], errors[1])
                )
    return tuple(found)
