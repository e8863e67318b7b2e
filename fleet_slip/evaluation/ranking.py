"""Ranking of estimators on test drives, and comparison of models trained on two cohorts."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from fleet_slip.evaluation.evaluator import EvaluatedDrive
from fleet_slip.evaluation.test_drives import TestDrive
from fleet_slip.simulation.scenario import Failure, Scenario
from fleet_slip.simulation.sensors import GPS_SIGNALS, Gps

MIN_COVERAGE = 0.99
"""Share of a drive's rows with an estimate below which an estimator does not compete."""

CLOSE = 1.25
"""Ratio to the winner's RMSE up to which a lost drive counts as close."""


def rank(
    runs: Sequence[EvaluatedDrive[TestDrive]], estimator: str, gps: Collection[str]
) -> dict[str, Any]:
    """Rank an estimator on every drive against all that use no GPS; it wins a tie.

    Returns the section of a document. Drives that differ in satellite navigation alone count once:
    `same_as` names the first.
    """
    standings = [
        {
            "scenario": run.name,
            **_standing(run, estimator, gps),
            "same_as": _same_as(run.drive.scenario, runs[:number]),
        }
        for number, run in enumerate(runs)
    ]
    counted = [standing for standing in standings if standing["same_as"] is None]
    lost = [row["ratio"] for row in counted if row["ratio"] is not None and not row["won"]]
    return {
        "estimator": estimator,
        "least_coverage": MIN_COVERAGE,
        "close_ratio": CLOSE,
        "drives": len(counted),
        "won": sum(row["won"] for row in counted),
        "close": sum(ratio <= CLOSE for ratio in lost),
        "standings": standings,
    }


def _standing(
    run: EvaluatedDrive[TestDrive], estimator: str, gps: Collection[str]
) -> dict[str, Any]:
    """Return the best estimator of a drive (None without competitors), and this one's verdict."""
    errors = {
        name: statistics.rmse_deg
        for name, statistics in run.statistics.items()
        if name not in gps
        and statistics.rmse_deg is not None
        and statistics.coverage >= MIN_COVERAGE
    }
    rmse_deg = errors.get(estimator)
    winner = min(errors, key=lambda name: (errors[name], name != estimator), default=None)
    winner_deg = errors[winner] if winner else None
    return {
        "winner": winner,
        "winner_rmse_deg": winner_deg,
        "rmse_deg": rmse_deg,
        "won": winner == estimator,
        "ratio": rmse_deg / winner_deg if rmse_deg is not None and winner_deg else None,
    }


def _same_as(scenario: Scenario, runs: Sequence[EvaluatedDrive[TestDrive]]) -> str | None:
    """Return the first of some drives that is the same to an estimator without GPS."""
    gps = scenario.sensors.gps
    key = _with_gps(gps, scenario)
    return next((run.name for run in runs if _with_gps(gps, run.drive.scenario) == key), None)


def _with_gps(gps: Gps, scenario: Scenario) -> tuple[str, tuple[Failure, ...]]:
    """Return what of a scenario matters to an estimator without GPS, all with the same GPS."""
    sensors = scenario.sensors.model_copy(update={"gps": gps})
    drive = scenario.model_copy(update={"drive": "any", "sensors": sensors}).batch()
    failures = tuple(f for f in scenario.failures if not set(f.signals) <= set(GPS_SIGNALS))
    return drive.digest, failures


def compare_models(
    runs: Sequence[EvaluatedDrive[TestDrive]],
    one_car: Mapping[str, str],
    fleet: Mapping[str, str],
) -> Iterator[dict[str, Any]]:
    """Compare the models of Table I of two cohorts, by number, wherever both have estimates."""
    for run in runs:
        for number in (number for number in one_car if number in fleet):
            names = one_car[number], fleet[number]
            one_car_deg, fleet_deg = (run.statistics[name].rmse_deg for name in names)
            if one_car_deg is not None and fleet_deg is not None:
                yield {
                    "scenario": run.name,
                    "model": number,
                    "one_car": names[0],
                    "fleet": names[1],
                    "one_car_rmse_deg": one_car_deg,
                    "fleet_rmse_deg": fleet_deg,
                    "better": names[0] if one_car_deg <= fleet_deg else names[1],
                }
