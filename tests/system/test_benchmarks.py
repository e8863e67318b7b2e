"""Every benchmark runs, with tiny sizes, and every page that names one names one that is there."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.commands import done_on
from tests.support.model_lists import write_list
from tests.support.once import made_once

HERE = Path(__file__).resolve().parents[2]
BENCHMARKS = HERE / "benchmarks"
DEADLINE_S = 1800
"""Each takes some seconds on an idle machine."""

TINY = {
    "billion": "--root {folder} --rows 3e4",
    "cluster": "--days 1 --workers 1",
    "exact_columns": "8",
    "flips": "--flips 1",
    "fuzz": "--cases 10 --target config",
    "goals": "{root} few --roads 1",
    "growth": "--root {folder} --part versions --sizes 2",
    "ingest": "--rows 2000,4000",
    "ingest_folder": "--files 3 --rows 100",
    "measured_page": "--check",
    "message_lake": "--sessions 2 --messages 4",
    "on_board": "{root} smoke --seconds 0.01",
    "peers": "--root {root} --campaign smoke --only fleet_slip duckdb scikit-learn",
    "pipeline": "--root {root} --campaign smoke --threads 1 --gram-rows 200",
    "quality": "{root}",
    "refit": "{root} true",
    "simulator": "--seconds 0.01 --threads 1",
    "simulator_profile": "--campaign smoke",
    "traffic": "--drives 1",
    "soak": "--minutes 0.03",
    "start": "--rounds 1",
    "statistics_figures": "{root} smoke --output {folder}",
    "validation": "",
}
"""Arguments of tiny sizes. `{root}` is a data root, see `tiny_root`."""

RUN_BY = {
    "crash": "system/test_crash.py",
    "interleave": "operations/test_races.py",
    "rivals": "system/test_rivals.py",
}
"""Benchmarks that separate tests run with larger sizes."""

ELSEWHERE = {"weka": "WEKA and a JVM"}
"""Benchmarks that do not run here, and what they need."""

PARTS = {"__main__", "peer_ways", "usage"}
"""Modules that benchmarks start as processes."""


@pytest.fixture(scope="session")
def tiny_root(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """A data root with a published model, and a day of many cars with what is known of them."""

    def make(root: Path) -> None:
        shutil.copytree(smoke_root, root)
        short_list = root.with_name("few.toml")
        short_list.write_text(
            'name = "few"\nbase = "fleet"\ndrives_per_day = 8\nlaps = 0.1\n'
            'plan.vehicles = ["d_class_sedan"]\n'
        )
        done_on(root, "simulate", short_list, "--days", "1")
        done_on(root, "gram")
        list_path = write_list(root.with_name("list.toml"), "ay")
        done_on(
            root, "publish", "few", "--models", list_path, "--cohort", "campaign = 'few'", "--force"
        )

    return made_once(tmp_path_factory, "benchmarks", make)


@pytest.mark.long
@pytest.mark.timeout(2 * DEADLINE_S)
@pytest.mark.parametrize("name", TINY)
def test_a_benchmark_runs_with_tiny_sizes(name: str, tiny_root: Path, tmp_path: Path) -> None:
    before = checkout()
    root = shutil.copytree(tiny_root, tmp_path / "data")
    arguments = shlex.split(TINY[name].format(root=root, folder=tmp_path / "folder"))
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *arguments],
        cwd=tmp_path,  # what it writes stays here
        env={**os.environ, "PYTHONPATH": str(HERE)},
        capture_output=True,
        text=True,
        check=False,
        timeout=DEADLINE_S,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert done.stdout
    assert checkout() == before


@pytest.mark.long
@pytest.mark.timeout(DEADLINE_S)
def test_an_ingest_takes_no_more_of_polars_than_recorded() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.ingest", "--check"],
        cwd=HERE,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def checkout() -> dict[Path, int]:
    """Return when each file was written that a benchmark might take for its own."""
    files = (
        path for folder in ("docs", "benchmarks", "configs") for path in (HERE / folder).rglob("*")
    )
    return {
        path: path.stat().st_mtime_ns for path in files if path.is_file() and path.suffix != ".pyc"
    }


def test_a_benchmark_names_the_package_that_is_missing(tmp_path: Path) -> None:
    lacking = "raise ModuleNotFoundError('No module', name='highway_env')"
    (tmp_path / "highway_env.py").write_text(lacking)
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.simulator"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{HERE}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("This benchmark needs the package highway_env, which is not")
    assert "Traceback" not in done.stderr


def programs() -> set[str]:
    """Return the names under which `python -m benchmarks.NAME` starts something."""
    modules = {
        path.stem
        for path in BENCHMARKS.glob("*.py")
        if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
    }
    return (modules | {"fuzz", "rivals"}) - PARTS


def named_in(page: Path) -> set[str]:
    """Return the benchmarks that a page tells to run."""
    return set(re.findall(r"python -m benchmarks\.([\w.]*\w)", page.read_text(encoding="utf-8")))


def test_every_benchmark_has_tiny_sizes_or_a_test_or_needs_what_is_not_here() -> None:
    assert sorted(programs()) == sorted([*TINY, *RUN_BY, *ELSEWHERE])
    for name, file in RUN_BY.items():
        text = (HERE / "tests" / file).read_text(encoding="utf-8")
        assert re.search(rf'"(-m )?benchmarks\.{name}[ "]', text), file


def test_every_command_of_the_measurements_is_one_of_them() -> None:
    named = named_in(HERE / "docs/measured.md")
    assert len(named) > 10
    assert named <= programs()


def test_every_benchmark_is_named_by_a_page() -> None:
    pages = [HERE / "CONTRIBUTING.md", *(HERE / "docs").rglob("*.md")]
    assert set().union(*map(named_in, pages)) == programs()


def test_make_bench_runs_what_is_there() -> None:
    text = (BENCHMARKS / "__main__.py").read_text(encoding="utf-8")
    commands = re.findall(r'^    "(\w+)[^"]*",$', text, re.M)
    assert commands
    assert set(commands) <= programs()


def test_no_test_imports_a_benchmark() -> None:
    """Shared code is in tests/support; the rivals are a small package."""
    pattern = re.compile(r"^\s*(?:from|import) benchmarks\b(?!\.rivals)", re.M)
    tests = (HERE / "tests").rglob("*.py")
    assert [str(path) for path in tests if pattern.search(path.read_text("utf-8"))] == []
