"""Drives whose rows are checked: at ingest each file's, in a data root some of a cohort."""

from pathlib import Path

import numpy as np
import polars as pl

from fleet_slip.errors import AlarmError, RefusedError
from fleet_slip.quality.drive_signals import WHEELS
from tests.support.commands import run_on
from tests.support.model_lists import write_list
from tests.support.textbook_car import Car, winding_car

UNITS = {"ax": "m/s^2", "ay": "m/s^2", "yaw_rate": "rad/s", "vx": "m/s"}
UNITS |= dict.fromkeys(WHEELS, "rad/s")
HEAD = """name = "car"
time = { column = "t", unit = "s" }
drive = { day = 2024-05-31, vehicle_id = "car", vehicle_model = "sedan" }
"""


def write_drives(folder: Path, *cars: Car) -> tuple[str, ...]:
    """Write a file for each car; return the words of an ingest."""
    logs = folder / "logs"
    logs.mkdir()
    for i, car in enumerate(cars):
        time_s = np.arange(car["ay"].size) / 100
        frame = pl.DataFrame({"t": time_s, **car}).with_columns(pl.all().fill_nan(None))
        frame.write_csv(logs / f"M{i + 1}.csv")
    signals = (
        f'signals.{name} = {{ column = "{name}", unit = "{UNITS.get(name, "rad")}" }}\n'
        for name in cars[0]
    )
    (folder / "car.toml").write_text(HEAD + "".join(signals))
    return "ingest", str(logs), "--mapping", str(folder / "car.toml")


def drives(number: int) -> list[Car]:
    return [winding_car(seed, seconds=40) for seed in range(number)]


def test_one_reversed_label_in_a_folder_is_found_and_left_out(tmp_path: Path) -> None:
    cars = drives(5)
    cars[3]["sideslip"] = -cars[3]["sideslip"]
    ingest, root = write_drives(tmp_path, *cars), tmp_path / "root"
    for words in ((*ingest, "--dry-run"), ingest):
        done = run_on(root, *words)
        assert done.exit_code == AlarmError.exit_code
        (line,) = [
            line for line in (done.stdout + done.stderr).splitlines() if "looks wrong" in line
        ]
        assert "reversed sideslip?" in line
    assert run_on(root, "gram").exit_code == 0
    done = run_on(root, "quality", "--json")
    assert done.exit_code == AlarmError.exit_code
    assert [(f["kind"], f["signals"]) for f in done.json["findings"]] == [
        ("reversed", ["sideslip"])
    ]
    assert done.json["systematic"] == []
    done = run_on(root, "select", "--models", "table1")
    assert "1 drive of 5 left out: faulty sensors (1 reversed sideslip)" in done.stderr


def test_a_label_that_is_late_in_all_drives_leaves_none_out_and_is_not_published(
    tmp_path: Path,
) -> None:
    cars = drives(4)
    for car in cars:
        car["sideslip"] = np.concatenate([np.full(100, np.nan), car["sideslip"][:-100]])
    ingest, root = write_drives(tmp_path, *cars), tmp_path / "root"
    done = run_on(root, *ingest, "--json")
    assert [len(report["suspicions"]) for report in done.json] == [1, 0, 0, 0]
    figure = done.json[0]["suspicions"][0]["figure"]
    assert figure.startswith("it is +1.00 s late") and figure.endswith(", as in 3 other files")
    run_on(root, "gram")
    report = run_on(root, "quality", "--json")
    assert report.exit_code == AlarmError.exit_code
    assert (report.json["findings"], report.json["inspected"]) == ([], 4)
    assert [fault["kind"] for fault in report.json["systematic"]] == ["late"]
    assert "in most of 4 inspected drives: late sideslip?" in run_on(root, "quality").stdout
    done = run_on(root, "publish", "m", "--models", "table1")
    assert done.exit_code == RefusedError.exit_code
    assert "Add 1.00 to its delay_s" in done.stderr


def test_a_first_champion_is_refused_for_a_wrong_unit_of_signals_that_it_does_not_use(
    tmp_path: Path,
) -> None:
    cars = drives(4)
    for car in cars:
        car["vx"] = 0.31 * np.mean([car[name] for name in WHEELS], axis=0)
        car |= {name: car[name] / 9.55 for name in WHEELS}
    ingest, root = write_drives(tmp_path, *cars), tmp_path / "root"
    run_on(root, *ingest)
    run_on(root, "gram")
    models = write_list(tmp_path / "own.toml", "ay,yaw_rate,steering_wheel")
    done = run_on(root, "publish", "m", "--models", models)
    assert done.exit_code == RefusedError.exit_code
    assert "scaled wheel_fl, wheel_fr, wheel_rl, wheel_rr? vx is 9.55 times" in done.stderr
    assert run_on(root, "publish", "m", "--models", models, "--force").exit_code == 0


def test_a_drive_with_two_sets_of_signals_is_one_drive(tmp_path: Path) -> None:
    (car,) = drives(1)
    car["sideslip"][2000:] = np.nan
    root = tmp_path / "root"
    run_on(root, *write_drives(tmp_path, car))
    run_on(root, "gram")
    done = run_on(root, "quality", "--json")
    assert (done.exit_code, done.json["drives"]) == (0, 1)


def test_a_label_at_standstill_is_not_stored(tmp_path: Path) -> None:
    """Optical and satellite sensors report noise there: it destroyed models of plain signals."""
    (car,) = drives(1)
    rng = np.random.default_rng(3)
    stands = {name: 1e-3 * rng.normal(size=2000) for name in car}
    stands["sideslip"] = rng.normal(0, 0.35, 2000)
    car = {name: np.concatenate([values, stands[name]]) for name, values in car.items()}
    root = tmp_path / "root"
    run_on(root, *write_drives(tmp_path, car))
    query = "SELECT count(*) AS rows, count(sideslip_rad) AS labels FROM log"
    done = run_on(root, "sql", query, "--json")
    assert done.json == [{"rows": 6000, "labels": 4000}]


def test_a_log_of_a_standing_car_is_stored_without_its_label(tmp_path: Path) -> None:
    """Its label is on the ticks, and is left out because of the speed alone."""
    (car,) = drives(1)
    rng = np.random.default_rng(4)
    car = {name: 1e-3 * rng.normal(size=1000) for name in car}
    car["sideslip"] = rng.normal(0, 0.35, 1000)
    root = tmp_path / "root"
    run_on(root, *write_drives(tmp_path, car))
    query = "SELECT count(*) AS rows, count(sideslip_rad) AS labels FROM log"
    assert run_on(root, "sql", query, "--json").json == [{"rows": 1000, "labels": 0}]
