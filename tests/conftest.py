"""Fixtures of all tests: a warehouse, the command line as a user runs it, and the same examples."""

import gc
import os
import shutil
import signal
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, is_hypothesis_test, settings

from fleet_slip.resources import cache_folder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.budget import Budget
from tests.support.commands import Finished, RunCommand, done_on, run_on
from tests.support.once import compile_once, made_once, require_unchanged

# A test that has a cache of its own does not compile anew, which takes half a minute.
os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder("compiled")))

if "PYTEST_XDIST_WORKER" in os.environ:
    compile_once()

# A shell ignores interrupts for what it starts in the background, and so would all that is started.
signal.signal(signal.SIGINT, signal.default_int_handler)

# No test cuts the power, and to wait for the disk takes as long as the rest of a commit.
os.fsync = os.fstat  # type: ignore[assignment]

# The same examples in every run, half as many as usual, and none that fails because the machine is
# busy. `make test` tries a part of them; the option --hypothesis-profile=search looks for new ones.
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile(
    "fixed", settings.get_profile("search"), derandomize=True, max_examples=50
)
settings.load_profile("fixed")

QUICK = 3
"""`make test` tries one example of so many; `make test-all` tries them all."""

LEFT_OUT = pytest.StashKey[dict[str, int]]()
"""How many tests were left out because of each tool, or of the minutes that they take."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--tools",
        action="store_true",
        help="run the tests that need outside programs or minutes, and no others",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Budget())


def tools_of(item: pytest.Item) -> list[str]:
    """Return the outside programs that a test needs."""
    return [name for marker in item.iter_markers("tools") for name in marker.args]


def why_left_out(item: pytest.Item) -> list[str]:
    """Return for what a test is left to `make test-all`; nothing if it is not."""
    return [*tools_of(item), *(["minutes"] if item.get_closest_marker("long") else [])]


def tries_examples(item: pytest.Item) -> bool:
    """Return True for tests of hypothesis, of which `make test` tries a part."""
    return is_hypothesis_test(getattr(item, "obj", None))


def try_fewer(test: Any) -> None:
    """Let a test of hypothesis try one example of `QUICK`, but five if it has them."""
    settings_ = test._hypothesis_internal_use_settings  # its own pytest plugin asks so, too
    fewer = max(settings_.max_examples // QUICK, min(settings_.max_examples, 5))
    test._hypothesis_internal_use_settings = settings(settings_, max_examples=fewer)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Look through what all tests import neither while it grows nor once it is there."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
        gc.set_threshold(50_000, 20, 20)  # a test makes many objects, and few circles of them


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    with_tools = config.getoption("--tools")
    deselected = [item for item in items if bool(why_left_out(item)) != with_tools]
    if with_tools:
        deselected = [item for item in deselected if not tries_examples(item)]
    elif settings.get_current_profile_name() == "fixed":
        for test in {item.obj for item in items if tries_examples(item)}:  # type: ignore[attr-defined]
            try_fewer(test)
    out = set(deselected)
    items[:] = [item for item in items if item not in out]
    config.hook.pytest_deselected(items=deselected)
    names = [name for item in deselected for name in why_left_out(item)]
    config.stash[LEFT_OUT] = {name: names.count(name) for name in sorted(set(names))}


def pytest_runtest_setup(item: pytest.Item) -> None:
    missing = [name for name in tools_of(item) if shutil.which(name) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} is not here: tests/tools/install {' '.join(missing)}")


def pytest_runtest_teardown(item: pytest.Item) -> None:
    require_unchanged(getattr(item, "funcargs", {}).values())


def pytest_sessionfinish(session: pytest.Session) -> None:
    gc.unfreeze()  # or DuckDB takes what is left at the end for leaks
    if hasattr(session.config, "workeroutput"):  # of pytest-xdist, for the process that reports
        session.config.workeroutput["left_out"] = session.config.stash.get(LEFT_OUT, {})


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    node.config.stash[LEFT_OUT] = getattr(node, "workeroutput", {}).get("left_out", {})


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    for name, count in config.stash.get(LEFT_OUT, {}).items():
        terminalreporter.write_line(f"left to `make test-all`: {count} tests that need {name}")


@pytest.fixture
def run_command(tmp_path: Path) -> RunCommand:
    """Run `fleet-slip --root <tmp_path>/data ...`, see `run_on`."""

    def run(*arguments: str, root: Path | None = None, **options: Any) -> Finished:
        return run_on(root or tmp_path / "data", *arguments, cwd=tmp_path, **options)

    return run


@pytest.fixture
def warehouse(tmp_path: Path) -> Warehouse:
    """An empty warehouse."""
    return Warehouse(LocalFolder(tmp_path / "data"))


@pytest.fixture(scope="session")
def smoke_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root after `fleet-slip run --campaign smoke`. Nothing may change it: copy it first."""

    def make(root: Path) -> None:
        done_on(root, "run", "--campaign", "smoke")

    return made_once(tmp_path_factory, "smoke", make)


@pytest.fixture
def smoke_copy(tmp_path: Path, smoke_root: Path) -> Path:
    """A copy of it for one test, where `run_command` runs."""
    return shutil.copytree(smoke_root, tmp_path / "data")


@pytest.fixture(scope="session")
def root_to_fail_in(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """A copy of it in which commands may fail: `status` tells of them from then on."""
    return shutil.copytree(smoke_root, tmp_path_factory.mktemp("mistakes") / "data")


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read all formats in this process, so that a test can change how."""
    from fleet_slip.ingest.formats import confined_reader, reading  # noqa: PLC0415 - takes a while

    monkeypatch.setattr(reading, "open_confined", confined_reader.open_here)
