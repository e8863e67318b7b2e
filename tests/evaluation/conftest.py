"""Tuned parameters of the filters, found once: tuning takes most of the time of an evaluation."""

import shutil
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.support.once import made_once
from tests.support.reported import SCENARIOS, call


@pytest.fixture(scope="session")
def evaluated(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """A copy of `smoke_root` with an evaluation. Nothing may change it: copy it first."""

    def make(root: Path) -> None:
        shutil.copytree(smoke_root, root)
        call(root, "evaluate", "smoke", *SCENARIOS)

    return made_once(tmp_path_factory, "evaluated", make)


@pytest.fixture(scope="session")
def executor() -> Iterator[Executor]:
    """Threads on which parameters are sought."""
    with ThreadPoolExecutor(2) as threads:
        yield threads
