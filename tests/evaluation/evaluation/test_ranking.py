"""Who wins a test drive: by RMSE, without satellite navigation, without leaving rows out."""

from collections.abc import Callable

import numpy as np
import pytest
from rich.text import Text

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.accuracy import print_ranking
from fleet_slip.evaluation.drives import EvaluatedDrive, visible_signals
from fleet_slip.evaluation.evaluate import Ranking, rank
from fleet_slip.evaluation.filters import Signals
from fleet_slip.evaluation.scenarios import EvaluatedScenario, evaluate_drive
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


def test_the_smallest_error_wins() -> None:
    (one,) = rank([run(ours=0.3, ekf=0.2, net=0.25)], "ours", gps=()).standings
    assert (one.winner, one.best_other, one.won) == ("ekf", "ekf", False)
    assert one.ratio == pytest.approx(1.5)
    (two,) = rank([run(ours=0.3, ekf=0.2, net=0.25)], "ekf", gps=()).standings
    assert (two.winner, two.best_other, two.won, two.ratio) == ("ekf", "net", True, 1.0)
    assert two.best_other_rmse_deg == pytest.approx(0.25)


def test_a_bias_is_an_error() -> None:
    assert rank([run(ours=-0.3, ekf=0.2)], "ours", gps=()).won == 0


def test_satellite_navigation_does_not_compete() -> None:
    found = rank([run(ours=0.3, kalman=0.1, ekf=0.4)], "ours", gps={"kalman"})
    assert found.won == 1
    assert found.standings[0].best_other == "ekf"


def test_who_leaves_rows_out_neither_wins_nor_is_close() -> None:
    (one,) = rank([run(ours=(0.1, 11), ekf=0.2)], "ours", gps=()).standings
    assert (one.winner, one.rmse_deg, one.ratio, one.won) == ("ekf", None, None, False)
    (two,) = rank([run(ours=(0.1, 10), ekf=0.2)], "ours", gps=()).standings
    assert two.won


def test_drives_that_differ_in_satellite_navigation_alone_count_once() -> None:
    names = ("gps_clear", "nominal", "gps_urban", "wheel_missing", "gps_tunnel", "noise_doubled")
    found = rank([run(load_scenario(name), ours=0.1, ekf=0.2) for name in names], "ours", gps=())
    same = [one.same_as for one in found.standings]
    assert same == [None, "gps_clear", "gps_clear", None, "gps_clear", None]
    document = found.as_dict()
    assert (document["drives"], document["won"]) == (3, 3)
    assert len(document["standings"]) == 6


def test_nobody_wins_a_drive_without_estimates() -> None:
    (one,) = rank([run(ours=(0.1, ROWS), ekf=(0.1, ROWS))], "ours", gps=()).standings
    assert (one.winner, one.won, one.ratio) == (None, False, None)


def test_wins_and_close_losses_are_counted_apart() -> None:
    nominal = load_scenario("nominal")
    runs = [
        run(nominal.model_copy(update={"seed": seed}), ours=error, ekf=0.2)
        for seed, error in enumerate((0.1, 0.2, 0.24, 0.26))
    ]
    found = rank(runs, "ours", gps=())
    assert (found.won, found.close) == (2, 1), "a tie is won, 1.2 is close and 1.3 is not"
    document = found.as_dict()
    assert (document["drives"], document["won"], document["close"]) == (4, 2, 1)
    assert [one["won"] for one in document["standings"]] == [True, True, False, False]


@pytest.mark.parametrize("columns", [80, 100, 160])
def test_the_table_keeps_its_numbers_whole(
    columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", str(columns))
    ranking: Ranking = rank([run(ours=0.3, ekf_class_tuned=0.2)], "ours", gps=())
    print_ranking(ranking.as_dict())
    printed = Text.from_ansi(capsys.readouterr().out).plain
    assert "ours/3 is model 3 of Table I" in " ".join(printed.split())
    table = printed[printed.index("scenario") :]
    assert max(map(len, table.splitlines())) <= columns
    for figure in ("ekf_class_tuned", "0.300", "0.200", "1.50"):
        assert figure in table
