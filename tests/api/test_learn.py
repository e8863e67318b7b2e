"""`learn` makes a model of measured logs: what each step does, once, and says what it assumed."""

import json
import random
import shutil
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.errors import ConfigError, RefusedError
from fleet_slip.ingest.columns import SignalColumn
from fleet_slip.ingest.mapping import (
    Mapping,
    assumptions_of,
    load_mapping,
    store_assumptions,
)
from fleet_slip.storage.local import LocalFolder
from tests.support.catalog import CATALOG
from tests.support.commands import Finished, run_on
from tests.support.measured import DRIVE, OWN_MAPPING, SIGNALS, TIME, csv_text, own_columns

MAPPING = OWN_MAPPING.replace('{ column = "car" }', '{ path = "{}/*" }').replace(
    "day = 2026-05-04", 'day = { path = "*_{}.csv" }'
)


def write_logs(folder: Path, cars: int, slip: float = -1.0) -> Path:
    rng = random.Random(5)  # noqa: S311
    (folder / "own.toml").write_text(MAPPING)
    for car in range(cars):
        place = folder / "logs" / f"car-{car}" / "drive_2026-05-04.csv"
        place.parent.mkdir(parents=True)
        place.write_text(csv_text(own_columns(rng, slip)))
    return folder / "logs"


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Finished, Finished]:
    """A folder with logs and a root, and what two calls said."""
    folder = tmp_path_factory.mktemp("learn")
    words = ("learn", "golf", write_logs(folder, 6), "--mapping", folder / "own.toml")
    first = run_on(folder / "root", *words)
    return folder, first, run_on(folder / "root", *words, "--json")


def test_it_publishes_and_says_what_it_assumed_and_what_comes_next(
    learned: tuple[Path, Finished, Finished],
) -> None:
    folder, first, _ = learned
    assert first.exit_code == 0, first.stderr
    for phrase in (
        "ingested 6 drives, 3,000 rows",
        "published golf@1. It is the first version.",
        "assumptions, since own has no other values:\n  side-slip sensor at the centre of gravity",
    ):
        assert phrase in first.stderr
    _, _, lines = first.stderr.partition("next:\n")
    commands = [line.split(f"--root {folder / 'root'} ")[1] for line in lines.splitlines()]
    assert [line.split()[0] for line in commands] == ["show", "export", "evaluate"]


def test_the_second_time_there_is_nothing_to_do(learned: tuple[Path, Finished, Finished]) -> None:
    _, _, again = learned
    assert again.exit_code == 0, again.stderr
    document = json.loads(again.stdout)
    assert (document["changed"], document["ingest"], document["select"]) == (False, [], None)
    assert document["publish"]["version"] == 1
    assert "sideslip is not delayed (delay_s)" in document["assumed"]


def test_cars_and_days_are_those_of_the_paths(learned: tuple[Path, Finished, Finished]) -> None:
    folder, _, _ = learned
    fleet = fleet_slip.open(folder / "root")
    rows = fleet.sql("SELECT vehicle_id, day::VARCHAR FROM drives ORDER BY 1").fetchall()
    assert rows == [(f"car-{car}", "2026-05-04") for car in range(6)]


def test_show_and_exports_list_the_assumptions(
    learned: tuple[Path, Finished, Finished], tmp_path: Path
) -> None:
    folder, _, _ = learned
    shown = run_on(folder / "root", "show", "golf")
    assert "assumed" in shown.stdout
    fleet = fleet_slip.open(folder / "root")
    assumed = list(fleet.models.get("golf").manifest.assumed)
    for to in ("c", "sql"):
        fleet.models.export("golf", to, tmp_path)
        name = f"sideslip_golf_{to}"
        assert json.loads((tmp_path / f"{name}_manifest.json").read_text())["assumed"] == assumed
        assert assumed[0] in (tmp_path / f"{name}_README.md").read_text()
    assert fleet.maintenance.verify().damage == []


def test_evaluate_lists_a_speed_that_replaces_the_wheels(
    learned: tuple[Path, Finished, Finished], tmp_path: Path
) -> None:
    folder, _, _ = learned
    root = shutil.copytree(folder / "root", tmp_path / "root")
    mapping = load_mapping(str(folder / "own.toml"), CATALOG)
    speed = SignalColumn(column="v", unit="km/h")
    signals = {**mapping.signals, "wheel_fl": speed, "wheel_fr": speed}
    store_assumptions(LocalFolder(root), mapping.model_copy(update={"signals": signals}))
    done = run_on(root, "evaluate", "golf", "--cohort", "source = 'measured'")
    assert "assumed: one speed of the car replaces the wheel speeds" in done.stderr
    assert "side-slip sensor" not in done.stderr


def test_a_version_without_assumptions_is_what_it_was(
    learned: tuple[Path, Finished, Finished],
) -> None:
    folder, _, _ = learned
    manifest = fleet_slip.open(folder / "root").models.get("golf").manifest
    assert "assumed" not in manifest.model_copy(update={"assumed": ()}).model_dump(mode="json")


def test_a_corrected_mapping_takes_the_place_of_the_old_one(
    learned: tuple[Path, Finished, Finished], tmp_path: Path
) -> None:
    folder, _, _ = learned
    mapping = load_mapping(str(folder / "own.toml"), CATALOG)
    fleet = fleet_slip.open(shutil.copytree(folder / "root", tmp_path / "root"))
    ax = mapping.signals["ax"].model_copy(update={"negate": True})
    corrected = mapping.model_copy(update={"signals": {**mapping.signals, "ax": ax}})
    report = fleet.learn("golf", folder / "logs", corrected)
    assert sum(item.drives_replaced for item in report.ingested) == 6
    assert report.problem is None
    assert fleet.sql("SELECT count(*) FROM drives").fetchall() == [(6,)]


def test_a_first_model_of_too_few_drives_is_refused_as_by_publish(tmp_path: Path) -> None:
    logs = write_logs(tmp_path, 2)
    done = run_on(tmp_path / "root", "learn", "golf", logs, "--mapping", tmp_path / "own.toml")
    assert done.exit_code == RefusedError.exit_code
    assert done.stderr.count("it was trained on 2 drives, fewer than 3") == 1
    assert "error: golf was not published, see above" in done.stderr


def test_a_mapping_without_any_label_is_an_error_that_says_so(tmp_path: Path) -> None:
    logs = write_logs(tmp_path, 1)
    text = MAPPING[: MAPPING.index("sideslip")]
    (tmp_path / "own.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"nothing to learn from\. Map sideslip .* or course"):
        fleet_slip.open(tmp_path / "root").learn("golf", logs, str(tmp_path / "own.toml"))
    assert not (tmp_path / "root").exists()


def test_a_path_that_does_not_fit_is_an_error(tmp_path: Path) -> None:
    write_logs(tmp_path, 1)
    stray = tmp_path / "logs" / "car-0" / "notes.csv"
    stray.write_text("t,ax,ay,r,beta\n0,0,0,0,0\n")
    done = run_on(tmp_path / "root", "ingest", stray, "--mapping", tmp_path / "own.toml")
    assert done.exit_code == 4
    assert "notes.csv: the path does not end as in path = '*_{}.csv'" in done.stderr


SPEED = {"column": "v", "unit": "km/h", "radius_m": 0.3}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"wheel_fl": {"column": "v", "unit": "km/h", "radius_m": 0.31}}, "wheel radius 0.31 m"),
        ({"steer": {"column": "s", "unit": "deg"}}, "both front wheels steer alike"),
        ({"wheel_fl": SPEED, "wheel_rr": SPEED}, "one speed of the car replaces the wheel speeds"),
        ({"vx": {"column": "v", "unit": "km/h"}}, "no wheel speeds"),
        ({}, "side-slip sensor at the centre of gravity"),
    ],
)
def test_open_keys_of_a_mapping_are_named(changed: dict[str, object], message: str) -> None:
    mapping = Mapping.model_validate(
        {"name": "m", "time": TIME, "drive": DRIVE, "signals": {**SIGNALS, **changed}},
        context=CATALOG.signals,
    )
    assert any(text.startswith(message) for text in assumptions_of(mapping))
