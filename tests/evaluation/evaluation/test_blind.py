"""The blind set: drives that follow from the hash of what they judge, and are kept nowhere."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.cli.output import print_parts
from fleet_slip.evaluation import scenario_evaluation
from fleet_slip.evaluation.evaluated_drives import TestDrive, blind_scenarios, simulate_drives
from fleet_slip.evaluation.evaluation_document import Evaluation
from fleet_slip.evaluation.scenario_evaluation import evaluate_blind_drives
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.scenario import Scenario, load_scenario
from fleet_slip.simulation.simulate import simulate_logs
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.reported import answer

HASH = "5e" * 32


@pytest.fixture(scope="module")
def scenarios() -> tuple[Scenario, ...]:
    """Return the blind drives of one hash."""
    return blind_scenarios(HASH, SHIPPED_CONFIGS)


@given(drawn=st.binary(min_size=32, max_size=32))
@settings(max_examples=3, deadline=None)  # half a second each
def test_every_hash_has_a_set_of_its_own(scenarios: tuple[Scenario, ...], drawn: bytes) -> None:
    drawn_set = blind_scenarios(drawn.hex(), SHIPPED_CONFIGS)
    assert len({scenario.name for scenario in drawn_set}) == len(drawn_set) == 24
    assert len({scenario.track.name for scenario in drawn_set}) == 8
    assert {scenario.seed for scenario in drawn_set}.isdisjoint(
        scenario.seed for scenario in scenarios
    )
    assert all(scenario.car.body.sprung_mass_kg > 0 for scenario in drawn_set), "every car can be"


def test_signals_are_quantised_as_in_a_log_and_the_truth_is_exact() -> None:
    scenario = load_scenario("imperfect", SHIPPED_CONFIGS)
    (drive,) = simulate_drives(SIGNALS, [scenario])
    (log,) = simulate_logs(SIGNALS, scenario.batch().drives)
    for name in SIGNALS.inputs:
        signal = SIGNALS[name]
        np.testing.assert_array_equal(
            np.rint(drive.columns[signal.column] / float(signal.scale)),
            log.measurement.counts[name],
        )
    np.testing.assert_array_equal(np.isfinite(drive.columns["gps_vx_mps"]), log.measurement.gps_fix)
    scale = float(SIGNALS["vy"].scale)
    assert np.abs(drive.vy_mps - scale * log.measurement.counts["vy"]).max() <= scale / 2 + 1e-12
    assert len(np.unique(drive.vy_mps)) > 0.99 * len(drive.vy_mps), "no counts"


def test_the_truth_has_no_error_and_zero_has_that_of_the_angle(
    scenarios: tuple[Scenario, ...],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On the first road and the last, in all weathers."""
    selected = (*scenarios[:3], *scenarios[-3:])
    monkeypatch.setattr(
        scenario_evaluation, "blind_scenarios", lambda sha256, _: {HASH: selected}[sha256]
    )
    drives = simulate_drives(SIGNALS, selected)
    monkeypatch.setattr(
        scenario_evaluation, "simulate_drives", lambda _, scenarios: drives
    )  # the same again

    def right(drive: TestDrive) -> np.ndarray:
        return drive.sideslip_rad

    def zero(drive: TestDrive) -> np.ndarray:
        return np.zeros_like(drive.sideslip_rad)

    def silent(drive: TestDrive) -> np.ndarray:
        return np.full_like(drive.sideslip_rad, np.nan)

    estimators = {"right": right, "zero": zero, "silent@1": silent}
    judged = evaluate_blind_drives(CATALOG, HASH, estimators)
    rows = {row["name"]: row for row in judged}
    assert rows["all"]["drives"] == 6
    assert [rows[name]["drives"] for name in ("dry", "wet", "ice")] == [2, 2, 2]
    assert all(row["results"]["right"]["rmse_deg"] == 0 for row in rows.values())
    zero_result = rows["all"]["results"]["zero"]
    assert zero_result["error_std_deg"] == pytest.approx(rows["all"]["sideslip_std_deg"], rel=1e-4)
    print_parts(Evaluation({"estimators": estimators, "drives": judged}).parts())
    output = capsys.readouterr().out
    assert "switchback" in output
    assert "0.000" in output
    assert "silent@1" in output and "none" in output


@pytest.mark.long
def test_the_command_evaluates_and_writes_nothing(evaluated: Path, tmp_path: Path) -> None:
    root = shutil.copytree(evaluated, tmp_path / "data")
    before = {path for path in root.rglob("*") if "runs" not in path.parts}
    document = answer(root, "evaluate", "smoke", "--blind")
    rows = {row["name"]: row["results"] for row in document["drives"]}
    assert rows["all"]["smoke@1"]["coverage"] > 0.95
    assert rows["all"]["smoke@1"]["rmse_deg"] > rows["all"]["smoke@1"]["error_std_deg"] > 0
    assert {path for path in root.rglob("*") if "runs" not in path.parts} == before
