"""The rivals that are fitted beside the package: they learn, and see what Gram rows are made of."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.rivals import anfis, learners
from benchmarks.rivals.__main__ import LEARNERS, all_signals
from benchmarks.rivals.inputs import Inputs, LearnedEstimate, RowSample, draw_sample
from benchmarks.rivals.learners import FittedLearner, hold_back, one_thread
from benchmarks.rivals.tree_filter import LeafNoise, TreeFilter, fit_tree_filter
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.evaluated_drives import LabelledDrive
from fleet_slip.evaluation.filters import FILTERS, FilterEstimate
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.storage.local import LocalFolder
from fleet_slip.vehicle.parameters import load_vehicle
from fleet_slip.views import connect
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.drives import noisy, slalom

HERE = Path(__file__).resolve().parents[2]
CAR = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
CLASS = next(spec for spec in FILTERS if spec.name == "ekf_class")


def sample(rows: int = 1200, drives: int = 12) -> RowSample:
    generator = np.random.default_rng(3)
    inputs = generator.standard_normal((rows, len(all_signals())))
    label = 0.02 * np.tanh(inputs[:, 1]) - 0.01 * inputs[:, 2]
    names = np.array([f"drive-{i % drives}" for i in range(rows)])
    return RowSample(all_signals(), inputs, label, names)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_learner_learns_drives_that_it_has_not_seen(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learners, "PASSES", 9)
    monkeypatch.setattr(learners, "MOST_TREES", 60)
    monkeypatch.setattr(anfis, "EPOCHS", 8)
    with one_thread():
        predictions = sample().cross_validated(LEARNERS[name], all_signals())
    assert predictions.coverage == 1
    assert predictions.error_std_deg is not None
    assert predictions.error_std_deg < 0.75 * np.degrees(sample().sideslip_rad.std())


def test_drives_are_held_back_completely() -> None:
    names = np.repeat([f"{number:03}" for number in range(20)], 7)
    mask = hold_back(names)
    assert mask.sum() == 14
    assert set(names[mask]).isdisjoint(names[~mask])


def test_a_rival_sees_on_a_drive_what_it_was_trained_on(smoke_root: Path) -> None:
    """Its estimate is the window itself: the same number in a sample and on a drive."""
    names = ("ay", "ay_mean_16")
    definition = {"ay_mean_16": CATALOG.time_columns["ay_mean_16"].definition}
    scale = float(SIGNALS["ay"].scale)
    inputs = Inputs({"ay": scale, "ay_mean_16": scale / 16}, {}, definition)
    warehouse = Warehouse(LocalFolder(smoke_root))
    cohort = load_cohort(warehouse, "campaign = 'smoke'")
    drawn = draw_sample(warehouse, cohort, inputs, rows=1000)
    assert drawn.names == names
    estimate = LearnedEstimate(inputs, FittedLearner(lambda rows: rows[:, 1], 0))
    drive_id = str(drawn.trip[0])
    with connect(smoke_root, query="log") as database:
        rows = database.sql(
            "SELECT ay_mps2 FROM log WHERE drive_id = $id ORDER BY time_s", params={"id": drive_id}
        ).fetchnumpy()
    signals = {"ay_mps2": np.ma.filled(rows["ay_mps2"].astype(float), np.nan)}
    stride = cohort.rows // 1000
    estimates = estimate.estimate(signals, {})[::stride]
    expected = drawn.inputs[drawn.trip == drive_id, 1]
    np.testing.assert_array_equal(estimates[np.isfinite(estimates)], expected)


@pytest.mark.long
def test_a_tree_without_factors_is_the_filter_and_never_worse_with_them() -> None:
    drive, truth = slalom(CAR, 1500)
    drives = [LabelledDrive(str(seed), noisy(drive, seed), truth) for seed in (1, 2)]
    base = FilterEstimate(CLASS, ekf.EkfNoise())
    with ThreadPoolExecutor(1) as executor:
        fitted = fit_tree_filter(base, CAR, drives, executor)

    def rms(spec: TreeFilter) -> float:
        errors = [spec.estimate(d.signals, CAR, spec.noise) - d.sideslip_rad for d in drives]
        return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))

    plain = replace(fitted, noise=LeafNoise())
    expected = ekf.estimate(drives[0].signals, CAR, ekf.EkfNoise())
    np.testing.assert_array_equal(plain.estimate(drives[0].signals, CAR, plain.noise), expected)
    assert rms(fitted) <= rms(plain)


@pytest.mark.long
def test_the_table_has_a_line_for_each_rival(smoke_root: Path) -> None:
    rivals = "regression_8,trees_windows"
    command = f"-m benchmarks.rivals {smoke_root} smoke --rows 2000 --drives nominal"
    done = subprocess.run(
        [sys.executable, *command.split(), "--rivals", rivals],
        cwd=HERE, capture_output=True, text=True, check=True,
    )  # fmt: skip
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines()]
    assert [line[0] for line in lines[2:]] == ["smoke", *rivals.split(",")]
    assert all(0 < float(line[-1]) < 1 for line in lines[2:])
