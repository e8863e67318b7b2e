"""A log with the columns of a real recording, from the file to the coefficients."""

import json
from pathlib import Path

import numpy as np
import pytest

from fleet_slip.columns.column_sql import column_query
from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.regression.inference import infer
from fleet_slip.regression.least_squares import fit
from fleet_slip.storage.local import LocalFolder
from fleet_slip.views import connect
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.measured import csv_text, ingest_file
from tests.support.reported import call

COEFFICIENTS = {"ax": 2e-4, "ay": -3e-3, "yaw_rate": 0.08, "steer_fl": 0.15, "steer_fr": 0.1}
OFFSET = 0.004
NOISE_RAD = 0.002
REMEMBERED = ("curvature_mean_16", "ay_mean_16")


def race_car_log(rows: int = 20_000) -> dict[str, list[float]]:
    """A made-up lap with the columns and mixed units of `race_car_250lm`, and a known model."""
    rng = np.random.default_rng(250)
    t = np.arange(rows) / 100
    periods_s = {"ax": 5.0, "ay": 9.0, "yaw_rate": 13.0, "steer_fl": 17.0, "steer_fr": 23.0}
    sizes = {"ax": 4.0, "ay": 6.0, "yaw_rate": 0.4, "steer_fl": 0.08, "steer_fr": 0.08}
    si = {
        name: sizes[name] * (np.sin(2 * np.pi * t / s) + 0.1 * rng.standard_normal(rows))
        for name, s in periods_s.items()
    }
    beta = OFFSET + sum(COEFFICIENTS[name] * values for name, values in si.items())
    beta = beta + 0.01 * rng.standard_normal(rows)
    vx = 30 + 5 * np.sin(t / 10)
    return {
        "time_s": [round(150 + float(x), 2) for x in t],
        "ax_mps2": si["ax"].tolist(),
        "ay_mps2": si["ay"].tolist(),
        "yaw_rate_rad_s": si["yaw_rate"].tolist(),
        "steer_fl_deg": np.degrees(si["steer_fl"]).tolist(),
        "steer_fr_deg": np.degrees(si["steer_fr"]).tolist(),
        "vx_kmh": (3.6 * vx).tolist(),
        "vy_kmh": (3.6 * vx * np.tan(beta)).tolist(),
        "sideslip_deg": np.degrees(beta).tolist(),
    }


def test_a_log_without_wheel_speeds_gives_its_model_through_the_shipped_mapping(
    tmp_path: Path,
) -> None:
    """The columns are those of a real recording, which is not ours to give away."""
    columns = race_car_log()
    file = tmp_path / "lap.csv"
    file.write_text(csv_text(columns))
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    report = ingest_file(warehouse, file, load_mapping("race_car_250lm", CATALOG))
    assert (report.counts.rows_kept, report.counts.ticks, report.counts.drives) == (
        20_000,
        20_000,
        1,
    )
    again = ingest_file(warehouse, file, load_mapping("race_car_250lm", CATALOG))
    assert [(report_.new, report_.drives_forgotten) for report_ in (report, again)] == [
        (True, 0),
        (False, 0),
    ]
    update_grams(warehouse)
    with connect(warehouse.root, query="drives, log") as database:
        answer = database.sql("SELECT vehicle_id, mass_kg, adhesion, rows FROM drives").fetchall()
        assert answer == [("250lm", None, None, 20_000)]
        rows = database.sql("FROM log ORDER BY tick").to_arrow_table()
    assert rows["wheel_fl_rad_s"].null_count == rows["steering_wheel_rad"].null_count == 20_000
    for name, column, unit in (
        ("sideslip", "sideslip_deg", np.pi / 180),
        ("steer_fl", "steer_fl_deg", np.pi / 180),
        ("vx", "vx_kmh", 1 / 3.6),
    ):
        signal = SIGNALS[name]
        half_a_count = 0.5001 * float(signal.scale)
        values = np.array(columns[column]) * unit
        np.testing.assert_allclose(rows[signal.column], values, rtol=0, atol=half_a_count)
    (table,) = load_cohort(warehouse).tables
    fitted = fit(table.total(), list(COEFFICIENTS), "sideslip")
    scales = {name: s.exact_scale for name, s in SIGNALS.signals.items()}
    for estimate, true in zip(
        infer(fitted, scales).estimates, [OFFSET, *COEFFICIENTS.values()], strict=True
    ):
        assert abs(estimate.value - true) < 4 * estimate.standard_error
        assert estimate.standard_error < 0.2 * abs(true)


def remembering_log(rows: int = 12_000) -> dict[str, list[float]]:
    """A made-up lap whose side-slip angle follows means over 0.16 s, at 18 to 42 m/s."""
    rng = np.random.default_rng(251)
    log = race_car_log(rows)
    t = np.arange(rows) / 100
    vx = 30 + 12 * np.sin(t / 7)
    ay, yaw_rate = np.array(log["ay_mps2"]), np.array(log["yaw_rate_rad_s"])
    beta = 1.3 * trailing_mean(yaw_rate / vx) - 0.004 * trailing_mean(ay)
    beta += NOISE_RAD * rng.standard_normal(rows)
    return log | {
        "vx_kmh": (3.6 * vx).tolist(),
        "vy_kmh": (3.6 * vx * np.tan(beta)).tolist(),
        "sideslip_deg": np.degrees(beta).tolist(),
    }


def trailing_mean(values: np.ndarray, ticks: int = 16) -> np.ndarray:
    return np.array([values[max(0, i + 1 - ticks) : i + 1].mean() for i in range(len(values))])


def test_memory_of_a_log_is_selected_and_holds_on_held_out_blocks(
    tmp_path: Path,
) -> None:
    """From the file to `--group-by part`: blocks of time left out of the training."""
    file = tmp_path / "lap.csv"
    file.write_text(csv_text(remembering_log()))
    root, models = tmp_path / "data", tmp_path / "models.toml"
    models.write_text(MODELS)
    call(root, "ingest", str(file), "--mapping", "race_car_250lm_speed")
    call(root, "gram", "--features", "blocks")
    command = ("select", "--group-by", "part", "--models", str(models), "--json")
    document = json.loads(call(root, *command))
    names = ["block 0001", "block 0002"]
    assert [fold["fold"] for fold in document["models"][0]["folds"]] == names
    instant, remembering = document["models"]
    assert remembering["rmse_deg"] == pytest.approx(np.degrees(NOISE_RAD), rel=0.05)
    assert instant["rmse_deg"] > 2 * remembering["rmse_deg"]
    last = remembering["folds"][-1]
    assert last["rmse_deg"] == pytest.approx(first_to_last_minute_deg(root), rel=1e-9)
    call(root, "gram")
    with pytest.raises(QuestionError, match=r"does not divide the rows of a drive.*time: blocks"):
        call(root, "select", "--group-by", "part")


def first_to_last_minute_deg(root: Path) -> float:
    """Fit to the first minute by numpy on the columns as SQL defines them, and test on the rest."""
    with connect(LocalFolder(root), query="log_counts") as database:
        columns = [
            np.array(
                database.sql(column_query(CATALOG, name)).fetchnumpy()[name],
                dtype=np.float64,
            )
            for name in REMEMBERED
        ]
        log = database.sql("SELECT * FROM log_counts ORDER BY tick").fetchnumpy()
    beta = np.asarray(log["sideslip"], dtype=np.float64) * float(SIGNALS["sideslip"].scale)
    last = np.asarray(log["tick"], dtype=np.int64) >= 6000
    matrix = np.column_stack([np.ones(len(beta)), *(c / np.abs(c).max() for c in columns)])
    weights = np.linalg.lstsq(matrix[~last], beta[~last], rcond=None)[0]
    error = np.degrees(matrix[last] @ weights - beta[last])
    return float(np.sqrt(np.mean(error**2)))


MODELS = """
description = "One instant, and memory"
features = "blocks"
[[model]]
name = "instant"
signals = ["curvature", "ay_signed_square"]
[[model]]
name = "remembering"
signals = ["curvature_mean_16", "ay_mean_16"]
"""
