"""What the filters are tuned to, sought once: that takes more than all else in an evaluation."""

import shutil
from pathlib import Path

import pytest

from tests.support.once import made_once
from tests.support.reported import call


@pytest.fixture(scope="session")
def tuned(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """The folder `tuned` of a copy of `smoke_root`, to be copied into others."""

    def make(root: Path) -> None:
        shutil.copytree(smoke_root, root)
        call(root, "evaluate", "smoke", "--scenario", "nominal")

    return made_once(tmp_path_factory, "tuned", make) / "tuned"
