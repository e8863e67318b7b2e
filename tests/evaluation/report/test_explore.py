"""The notebook over a data root, executed from its first cell to its last."""

import re
import shutil
from pathlib import Path

import pytest

from tests.support.commands import run

NOTEBOOK = Path(__file__).parents[3] / "jobs/explore.py"

pytestmark = pytest.mark.tools("marimo")


def executed(root: Path, folder: Path) -> tuple[int, str, str]:
    """Return the exit code, what was said, and the page."""
    program = shutil.which("marimo")
    assert program
    page, notebook = folder / "explore.html", folder / "explore.py"
    shutil.copy(NOTEBOOK, notebook)  # marimo keeps something beside it
    words = ["export", "html", str(notebook), "--output", str(page), "--", "--root", str(root)]
    done = run([program, *words])
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    return done.exit_code, done.stderr, text


def test_every_cell_works_on_a_root_with_a_model(smoke_root: Path, tmp_path: Path) -> None:
    code, told, page = executed(smoke_root, tmp_path)
    assert code == 0, told
    assert "8 drives" in page
    assert re.search(r"Coefficients over .{0,20}1 version of smoke", page)
    assert "image/png" in page


def test_without_a_model_it_says_so(smoke_root: Path, tmp_path: Path) -> None:
    ignored = shutil.ignore_patterns("models", "runs")
    root = shutil.copytree(smoke_root, tmp_path / "data", ignore=ignored)
    code, told, page = executed(root, tmp_path)
    assert code == 0, told
    assert "No model yet" in page
