"""Who wins a test drive: by RMSE, without satellite navigation, without leaving rows out."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rich.text import Text

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.output import print_parts
from fleet_slip.evaluation.drives import EvaluatedDrive, visible_signals
from fleet_slip.evaluation.evaluate import _ranking_table
from fleet_slip.evaluation.judge import EvaluatedScenario, Signals, evaluate_drive, rank
from fleet_slip.simulation.scenario import Scenario, load_scenario

ROWS = 1000


def drive(scenario: Scenario) -> EvaluatedDrive:
    """Return a drive straight ahead: the estimate is the error."""
    zeros, speed = np.zeros(ROWS), np.full(ROWS, 20.0)
    signals = {catalogue()[name].column: zeros for name in visible_signals()}
    time_s = np.arange(ROWS) / 100
    return EvaluatedDrive(scenario, time_s, signals, speed, zeros, zeros, zeros, None)


def off_by(error_deg: float, missing: int = 0) -> Callable[[Signals], FloatArray]:
    def estimate(signals: Signals) -> FloatArray:
        angles = np.full(len(signals["ay_mps2"]), np.radians(error_deg))
        angles[:missing] = np.nan
        return angles

    return estimate


def run(
    scenario: Scenario | None = None, **errors_deg: float | tuple[float, int]
) -> EvaluatedScenario:
    parts = {k: v if isinstance(v, tuple) else (v, 0) for k, v in errors_deg.items()}
    estimators = {name: off_by(*part) for name, part in parts.items()}
    return evaluate_drive(drive(scenario or load_scenario("nominal")), estimators)


def standing(one: EvaluatedScenario, estimator: str = "ours") -> dict[str, Any]:
    (found,) = rank([one], estimator, gps=())["standings"]
    return dict(found)


def test_the_smallest_error_wins() -> None:
    lost = standing(run(ours=-0.3, ekf=0.2, net=0.25))  # a bias is an error
    assert (lost["winner"], lost["won"]) == ("ekf", False)
    assert lost["ratio"] == pytest.approx(1.5)
    won = standing(run(ours=0.3, ekf=0.2, net=0.25), "ekf")
    assert (won["winner"], won["won"], won["ratio"]) == ("ekf", True, 1.0)


def test_satellite_navigation_does_not_compete() -> None:
    found = rank([run(ours=0.3, kalman=0.1, ekf=0.4)], "ours", gps={"kalman"})
    assert found["won"] == 1


def test_who_leaves_rows_out_neither_wins_nor_is_close() -> None:
    one = standing(run(ours=(0.1, 11), ekf=0.2))
    assert (one["winner"], one["rmse_deg"], one["ratio"], one["won"]) == ("ekf", None, None, False)
    assert standing(run(ours=(0.1, 10), ekf=0.2))["won"]
    nobody = standing(run(ours=(0.1, ROWS), ekf=(0.1, ROWS)))
    assert (nobody["winner"], nobody["won"], nobody["ratio"]) == (None, False, None)


def test_drives_that_differ_in_satellite_navigation_alone_count_once() -> None:
    names = ("gps_clear", "nominal", "gps_urban", "wheel_missing", "gps_tunnel", "noise_doubled")
    found = rank([run(load_scenario(name), ours=0.1, ekf=0.2) for name in names], "ours", gps=())
    same = [one["same_as"] for one in found["standings"]]
    assert same == [None, "gps_clear", "gps_clear", None, "gps_clear", None]
    assert (found["drives"], found["won"]) == (3, 3)


def test_wins_and_close_losses_are_counted_apart() -> None:
    nominal = load_scenario("nominal")
    runs = [
        run(nominal.model_copy(update={"seed": seed}), ours=error, ekf=0.2)
        for seed, error in enumerate((0.1, 0.2, 0.24, 0.26))
    ]
    found = rank(runs, "ours", gps=())
    assert (found["won"], found["close"]) == (2, 1), "a tie is won, 1.2 is close and 1.3 is not"
    assert [one["won"] for one in found["standings"]] == [True, True, False, False]


@pytest.mark.parametrize("columns", [80, 100, 160])
def test_the_table_keeps_its_numbers_whole(
    columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", str(columns))
    print_parts([_ranking_table(rank([run(ours=0.3, ekf_class_tuned=0.2)], "ours", gps=()))])
    printed = Text.from_ansi(capsys.readouterr().out).plain
    assert "ours/3 is model 3 of Table I" in " ".join(printed.split())
    table = printed[printed.index("scenario") :]
    assert max(map(len, table.splitlines())) <= columns
    for figure in ("ekf_class_tuned", "0.300", "0.200", "1.50"):
        assert figure in table
