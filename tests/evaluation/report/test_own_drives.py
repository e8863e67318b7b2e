"""Evaluation and report of a model of drives without wheel speeds, steering and navigation."""

import shutil
from pathlib import Path

import pytest

from tests.support.commands import Finished, done_on
from tests.support.own_logs import ingest_own
from tests.support.reported import Reported


@pytest.fixture(scope="module")
def judged(reported: Reported, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Finished]:
    """A data root with a model of such drives, and what its evaluation said."""
    folder = tmp_path_factory.mktemp("own")
    root = Path(shutil.copytree(reported.root, folder / "data"))
    ingest_own(root, folder, cars=5)
    done_on(root, "publish", "own", "--cohort", "source = 'measured'")
    return root, done_on(root, "evaluate", "own", "--scenario", "nominal")


@pytest.mark.long
def test_who_cannot_be_tuned_says_so_in_a_line_and_competes(
    judged: tuple[Path, Finished],
) -> None:
    _, done = judged
    assert "kalman left untuned: no GPS fix" in done.stderr
    assert "ekf_class left untuned" in done.stderr
    assert "nominal" in done.stdout


@pytest.mark.long
def test_the_report_has_what_is_left(judged: tuple[Path, Finished]) -> None:
    root, _ = judged
    done_on(root, "evaluate", "own", "--cohort", "source = 'measured'")
    done_on(root, "report", "own")
    page = (root / "report" / "report.html").read_text()
    assert "A car of one&#39;s own: measured drives" in page
    assert "on the nominal drive; of model 1" in page
    assert "lack signals of model 2, 3, 4 and 5 of Table I" in page
