"""Commands of README and pages run on the data of `make run`."""

import os
import shutil
import sys
from pathlib import Path

import pytest

from tests.docs.blocks import blocks, matches, printed_by, run
from tests.support.once import made_once

pytestmark = pytest.mark.long

HERE = Path(__file__).resolve().parents[2]
PAGES = [HERE / "README.md", HERE / "CONTRIBUTING.md", *sorted((HERE / "docs").rglob("*.md"))]
CODE = {str(page.relative_to(HERE)): page_blocks for page in PAGES if (page_blocks := blocks(page))}


@pytest.fixture(scope="session")
def fleet_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data root of `make run`, `data`, and its output, `printed`."""
    return made_once(tmp_path_factory, "make_run", make_run)


def make_run(folder: Path) -> None:
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        as_typed(patch, folder)
        printed = printed_by("fleet-slip run --campaign waterford")
    (folder / "printed").write_text(printed, encoding="utf-8")


def as_typed(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Let commands run in a folder, as in a terminal in which the environment is active."""
    patch.chdir(folder)
    patch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")
    for variable in ("FLEET_SLIP_ROOT", "FLEET_SLIP_CONFIG", "FLEET_SLIP_VERIFY_KEY"):
        patch.delenv(variable, raising=False)


@pytest.mark.parametrize("page", CODE)
def test_the_code_of_a_page_runs(
    page: str, fleet_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Nothing changes a file of a table in place, so that 30 MB need not be copied for each page.
    shutil.copytree(fleet_run / "data", tmp_path / "data", copy_function=link_tables)
    as_typed(monkeypatch, tmp_path)
    for block in CODE[page]:
        run(block, {"make run": (fleet_run / "printed").read_text(encoding="utf-8")})


def link_tables(file: str, copy: str) -> None:
    """Link a file of a table, and copy any other."""
    if file.endswith(".parquet"):
        os.link(file, copy)
    else:
        shutil.copy2(file, copy)


@pytest.mark.parametrize("page", CODE)
def test_every_block_is_run_or_marked_or_for_reading(page: str) -> None:
    assert [f"{page}:{b.line}: {b.fault}" for b in CODE[page] if b.fault] == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("```\nfleet-slip status\n```\n", "no language"),
        ("```sh\nfleet-slip status\n```\n", "sh"),
        ('```toml tittle="x.toml"\na = 1\n```\n', "unknown options"),
        ("<!-- not run: for reading -->\n```text\nx\n```\n", "never are"),
    ],
)
def test_a_block_of_another_kind_is_noticed(text: str, fault: str, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(text)
    assert fault in (blocks(page)[0].fault or "")


def test_a_failing_example_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    as_typed(monkeypatch, tmp_path)
    page = tmp_path / "page.md"
    page.write_text(
        "```console\n$ exit 3\n```\n\n```console\n$ echo 1\n2\n```\n\n"
        "```console\n$ fleet-slip show nothing\n```\n\n```python\nassert False\n```\n\n"
        "```bash\nfalse\ntrue\n```\n\n<!-- not run: fails -->\n```bash\nfalse\n```\n"
    )
    *failing, marked = blocks(page)
    assert len(failing) == 5
    for block in failing:
        with pytest.raises(AssertionError):
            run(block, {})
    run(marked, {})


@pytest.mark.parametrize(
    ("printed", "expected", "same"),
    [
        ("a  b\nc\n", "a b\nc", True),
        ("a b c", "a … c", True),
        ("a c", "a … c", True),
        ("a b c", "a …", True),
        ("done in 3.1 s", "done in … s", True),
        ("a b c", "a b", False),
        ("a b c", "b c", False),
        ("abc", "a.c", False),
        ("anything", "", True),
    ],
)
def test_output_matches(printed: str, expected: str, same: bool) -> None:
    assert matches(printed, expected) is same
