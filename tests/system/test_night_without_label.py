"""Nights of a fleet that has no sensor for the side-slip angle: from a CSV to two versions."""

import re
from pathlib import Path

import pytest

from tests.support.commands import done_on, run_on

PAGE = Path(__file__).parents[2] / "docs/course.md"
BLOCK = r'```\w+ title="([^"]+)"\n(.*?)```'
FILES = dict(re.findall(BLOCK, PAGE.read_text(encoding="utf-8"), re.DOTALL))
"""The files that the page tells its readers to write: a campaign, a mapping, and columns."""

pytestmark = [pytest.mark.long, pytest.mark.timeout(1800)]


def logged(folder: Path, name: str, seed: int) -> str:
    """Return the CSV of a car that drives a campaign of the page with another seed."""
    root, campaign = folder / name, folder / f"{name}.toml"
    text = FILES["small.toml"].replace("laps = 1", f"laps = 0.4\nseed = {seed}")
    campaign.write_text(text.replace('"small"', f'"{name}"'), encoding="utf-8")
    done_on(root, "simulate", str(campaign))
    return done_on(root, "sql", "--csv", FILES["as_a_logger.sql"]).stdout


def night(folder: Path, date: str) -> str:
    words = ["nightly", "--inbox", str(folder / "landing"), "--mapping", str(folder / "m.toml")]
    words += ["--model", "freed", "--models", "course", "--night", date]
    return done_on(folder / "fleet", *words, "--output", str(folder / f"{date}.md")).stdout


def test_a_night_learns_from_the_course_and_the_next_one_again(tmp_path: Path) -> None:
    (tmp_path / "landing").mkdir()
    (tmp_path / "m.toml").write_text(FILES["my_cars.toml"], encoding="utf-8")
    (tmp_path / "landing/one.csv").write_text(logged(tmp_path, "one", 7), encoding="utf-8")
    assert "freed@1" in night(tmp_path, "2024-06-01")
    (tmp_path / "landing/two.csv").write_text(logged(tmp_path, "two", 8), encoding="utf-8")
    output = " ".join(night(tmp_path, "2024-06-02").split())
    assert re.search(r"On the same .* held out", output), (
        "both versions, by what the course changes"
    )
    selection = run_on(tmp_path / "fleet", "select")
    assert selection.exit_code, "there is no label to learn from"
    assert "learn from it: fleet-slip select --label course" in selection.stderr
