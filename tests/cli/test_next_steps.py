"""What the first run says to type next works as it stands."""

import shlex
import shutil
from pathlib import Path

import pytest

from tests.support.commands import COMMAND, RunCommand, run_here


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A folder in which the program has run for the first time, and the lines after `next:`."""
    folder = tmp_path_factory.mktemp("first")
    done = run_here([COMMAND, "run", "--campaign", "smoke", "--models", "table1"], folder)
    assert done.exit_code == 0, done.stderr
    _, _, lines = done.stderr.partition("next:\n")
    return folder, lines.splitlines()


def test_each_command_can_be_typed(told: tuple[Path, list[str]]) -> None:
    folder, lines = told
    assert [shlex.split(line)[1] for line in lines] == ["sql", "show", "select", "evaluate"]
    for line in lines[:-1]:
        program, *arguments = shlex.split(line)
        done = run_here([str(folder / program), *arguments], folder)
        assert done.exit_code == 0, (line, done.stderr)
        assert done.stdout


def test_the_last_draws_the_report_of_the_model(told: tuple[Path, list[str]]) -> None:
    _, lines = told
    evaluate, report = lines[-1].split(" && ")
    assert evaluate.endswith("evaluate smoke")
    assert report.endswith("report smoke")


def test_another_root_stands_in_them(
    run_command: RunCommand, smoke_root: Path, tmp_path: Path
) -> None:
    shutil.copytree(smoke_root, tmp_path / "my data", ignore=shutil.ignore_patterns("models"))
    done = run_command(
        "run", "--campaign", "smoke", "--models", "table1", root=tmp_path / "my data"
    )
    assert f"--root '{tmp_path / 'my data'}' sql" in done.stderr


def test_they_are_said_once(told: tuple[Path, list[str]]) -> None:
    folder, _ = told
    again = run_here([COMMAND, "run", "--campaign", "smoke", "--models", "table1"], folder)
    assert "next:" not in again.stderr


def test_it_says_in_how_many_drives_the_car_was_lost(
    run_command: RunCommand, tmp_path: Path
) -> None:
    """A model of drives in control is one command away."""
    campaign = tmp_path / "ice.toml"
    campaign.write_text(
        'name = "ice"\ndescription = "Drives on ice"\nbase = "proving_ground"\nseed = 5\n'
        "number_of_days = 1\ndrives_per_day = 12\n"
        '[plan]\ntracks = ["switchback_1", "hill_2", "motorway_3"]\n'
        "[plan.adhesion]\nusual = 0.15\nshare = 1.0\nmin = 0.12\nmax = 0.2\n",
        encoding="utf-8",
    )
    done = run_command("run", "--campaign", str(campaign), root=tmp_path / "data")
    assert done.exit_code == 0, done.stderr
    assert " of 12 drives the car lost control" in done.stderr
    line = next(one for one in done.stderr.splitlines() if "lost_control_s IS NULL" in one)
    assert "publish ice --cohort \"campaign = 'ice' AND lost_control_s IS NULL\"" in line
