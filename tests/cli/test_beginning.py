"""A project of one's own: written whole, and what its README says works as it stands."""

import csv
import math
import os
import random
import shlex
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.support.commands import COMMAND, Finished, RunCommand, run_here

SIGNALS = ["ax_mps2", "ay_mps2", "yaw_rate_deg_s", "steering_wheel_deg"]
WHEELS = [f"wheel_{corner}_rad_s" for corner in ("fl", "fr", "rl", "rr")]
COLUMNS = ["time_s", "vehicle", "day", *SIGNALS, *WHEELS, "sideslip_deg"]


def drive_in(folder: Path, car: str, rows: int = 400) -> Path:
    """Write a log with the columns of the mapping that is to be filled in."""
    rng = random.Random(car)  # noqa: S311
    file = folder / f"{car}.csv"
    with file.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened)
        writer.writerow(COLUMNS)
        for tick in range(rows):
            ay = 3 * math.sin(tick / 30) + rng.gauss(0, 0.05)
            wheels = [60 + rng.gauss(0, 0.1) for _ in range(4)]
            turning = [math.degrees(ay / 20), ay * 8]
            sideslip = math.degrees(-ay / 200) + rng.gauss(0, 0.02)
            head = [tick / 100, car, "2026-05-04", rng.gauss(0, 0.3), ay]
            writer.writerow([*head, *turning, *wheels, sideslip])
    return file


def make(folder: Path, *options: str) -> Finished:
    return run_here([COMMAND, "--log", "text", "init", str(folder), *options])


def files_in(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_a_project_has_what_it_needs(tmp_path: Path) -> None:
    done = make(tmp_path / "mine")
    assert done.exit_code == 0, done.stderr
    assert files_in(tmp_path / "mine") == [
        "README.md",
        "configs/mappings/fleet.toml",
        "configs/monitor.toml",
        "configs/publish.toml",
        "configs/retention.toml",
        "crontab",
    ]
    readme = (tmp_path / "mine" / "README.md").read_text()
    assert done.stdout.strip() == readme.strip()
    assert len(readme.splitlines()) <= 12
    assert all(len(line) <= 80 for line in readme.splitlines() if line.startswith("    fleet"))
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    assert make(tmp_path / "mine").exit_code == 0, "an empty one is taken"
    before = files_in(tmp_path)
    done = make(tmp_path / "mine")
    assert (done.exit_code, files_in(tmp_path)) == (2, before)
    assert "it is not empty. Name a new folder." in done.stderr


@pytest.mark.parametrize("options", [["--model", "a b"], ["--log", "missing.csv"]])
def test_a_mistake_leaves_nothing(tmp_path: Path, options: list[str]) -> None:
    done = make(tmp_path / "mine", *options)
    assert done.exit_code in (2, 4)
    assert list(tmp_path.iterdir()) == []


def test_a_mapping_is_drafted_from_a_log(tmp_path: Path) -> None:
    log = drive_in(tmp_path, "first")
    assert make(tmp_path / "mine", "--model", "vans", "--log", str(log)).exit_code == 0
    text = (tmp_path / "mine/configs/mappings/vans.toml").read_text()
    assert 'name = "vans"' in text
    assert 'column = "ay_mps2"' in text


def test_signs_that_mean_something_in_cron_are_kept(tmp_path: Path) -> None:
    assert make(tmp_path / "50% mine").exit_code == 0
    night = (tmp_path / "50% mine" / "crontab").read_text().splitlines()[-1]
    assert "50\\% mine'/landing" in night
    assert "%" not in night.replace("\\%", "")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project, in the landing folder of which six cars' logs are."""
    folder = tmp_path_factory.mktemp("project") / "my fleet"
    assert make(folder).exit_code == 0
    for car in range(6):
        drive_in(folder / "landing", f"car-{car}")
    return folder


def commands_of(project: Path) -> tuple[Mapping[str, str], list[list[str]]]:
    """Return the environment that the README sets, and the commands that it says to type."""
    typed = [
        line.strip().partition("  #")[0]
        for line in (project / "README.md").read_text().splitlines()
        if line.startswith("    ")
    ]
    enter, *commands = typed
    folder, _, exports = enter.partition(" && export ")
    assert shlex.split(folder) == ["cd", str(project)]
    environment = dict(word.split("=") for word in exports.split())
    return {**os.environ, **environment}, [shlex.split(line) for line in commands[:-1]]


def test_what_the_readme_says_works(project: Path, run_command: RunCommand) -> None:
    environment, commands = commands_of(project)
    assert [words[1] for words in commands] == ["ingest", "nightly"]
    for _, *words in commands:
        given = ["landing/car-0.csv" if word == "landing/LOG" else word for word in words]
        done = run_here([COMMAND, *given], project, environment)
        assert done.exit_code == 0, (given, done.stdout, done.stderr)
    done = run_here([COMMAND, "show", "fleet"], project, environment)
    assert "fleet@1: sideslip_rad" in done.stdout
