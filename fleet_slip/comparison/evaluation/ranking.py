"""Who wins a test drive, and whether a fleet-trained model beats the one-car model there."""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from fleet_slip.comparison.evaluation.estimators import TrainedModels
from fleet_slip.comparison.evaluation.scenario_runs import EvaluatedScenario
from fleet_slip.simulation.scenario import Failure, Scenario, load_scenario
from fleet_slip.simulation.sensing.sensors import GPS_SIGNALS

LEAST_COVERAGE = 0.99
"""Share of a drive's rows that a competitor must have estimates for: who skips rows cannot win."""

CLOSE = 1.25
"""Ratio to the winner's RMSE up to which a lost drive counts as close."""


@dataclass(frozen=True)
class Standing:
    """How one estimator stands on one test drive against the others.

    Attributes:
        scenario: name of the test drive.
        winner, winner_rmse_deg: who has the smallest RMSE; None where nobody competes.
        rmse_deg: of the one estimator; None where it has too few estimates to compete.
        best_other, best_other_rmse_deg: the best of the others.
        same_as: an earlier test drive that differs from this one in satellite navigation alone, so
            that nobody who competes tells them apart.
    """

    scenario: str
    winner: str | None
    winner_rmse_deg: float | None
    rmse_deg: float | None
    best_other: str | None
    best_other_rmse_deg: float | None
    same_as: str | None = None

    @property
    def won(self) -> bool:
        """Whether the one estimator wins the drive."""
        return self.winner is not None and self.winner != self.best_other

    @property
    def ratio(self) -> float | None:
        """RMSE over that of the winner: 1 where it wins."""
        if self.rmse_deg is None or not self.winner_rmse_deg:
            return None
        return self.rmse_deg / self.winner_rmse_deg


@dataclass(frozen=True)
class Ranking:
    """How one estimator stands on all test drives; those that are the same count once."""

    estimator: str
    standings: tuple[Standing, ...]

    @property
    def counted(self) -> tuple[Standing, ...]:
        """The standings on drives that are not the same as one before."""
        return tuple(one for one in self.standings if one.same_as is None)

    @property
    def won(self) -> int:
        """Number of drives that it wins."""
        return sum(one.won for one in self.counted)

    @property
    def close(self) -> int:
        """Number of drives that it loses with at most `CLOSE` times the winner's RMSE."""
        return sum(
            one.ratio is not None and one.ratio <= CLOSE and not one.won for one in self.counted
        )

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON document needs."""
        return {
            "estimator": self.estimator,
            "least_coverage": LEAST_COVERAGE,
            "close_ratio": CLOSE,
            "drives": len(self.counted),
            "won": self.won,
            "close": self.close,
            "standings": [
                {**asdict(one), "won": one.won, "ratio": one.ratio} for one in self.standings
            ],
        }


def rank(runs: Sequence[EvaluatedScenario], estimator: str, gps: Collection[str]) -> Ranking:
    """Rank an estimator on every drive against all that use no GPS; it wins a tie."""
    return Ranking(
        estimator,
        tuple(
            replace(_stand(run, estimator, gps), same_as=_same_as(run.scenario, runs[:number]))
            for number, run in enumerate(runs)
        ),
    )


def _stand(run: EvaluatedScenario, estimator: str, gps: Collection[str]) -> Standing:
    errors = {
        name: result.whole.rmse_deg
        for name, result in run.results.items()
        if name not in gps
        and result.whole.rmse_deg is not None
        and result.whole.coverage >= LEAST_COVERAGE
    }
    ours = errors.pop(estimator, None)
    other = min(errors, key=lambda name: errors[name], default=None)
    others = None if other is None else errors[other]
    winner, least = other, others
    if ours is not None and (others is None or ours <= others):
        winner, least = estimator, ours
    return Standing(run.scenario.name, winner, least, ours, other, others)


def _same_as(scenario: Scenario, runs: Sequence[EvaluatedScenario]) -> str | None:
    """Return the first of some drives that is the same for whoever does not see GPS."""
    seen = _without_gps(scenario)
    return next((r.scenario.name for r in runs if _without_gps(r.scenario) == seen), None)


def _without_gps(scenario: Scenario) -> tuple[str, tuple[Failure, ...]]:
    """Return what of a scenario matters to who does not see GPS."""
    sensors = scenario.sensors.model_copy(update={"gps": load_scenario("nominal").sensors.gps})
    drive = scenario.model_copy(update={"drive": "any", "sensors": sensors}).batch()
    failures = tuple(f for f in scenario.failures if not set(f.signals) <= set(GPS_SIGNALS))
    return drive.digest, failures


@dataclass(frozen=True)
class FleetComparison:
    """RMSE of the same set of signals, trained on one car and on a fleet, on one scenario."""

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
