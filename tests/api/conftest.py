"""A data root with models, made once for all tests of the Python API."""

import subprocess
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip import Fleet
from tests.support.commands import COMMAND

FEATURES = "ay,yaw_rate,steering_wheel,speed_squared,curvature,course_rate,ay_signed_square"


@pytest.fixture(scope="session")
def smoke_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaign `smoke`, its model, and a model with features called `bent`."""
    root = tmp_path_factory.mktemp("api") / "data"
    for arguments in (
        ["run", "--campaign", "smoke"],
        ["gram", "--features", "motion"],
        ["publish", "bent", "--features", "motion", "--nested", FEATURES],
    ):
        subprocess.run([COMMAND, "--root", str(root), *arguments], check=True)
    return root


@pytest.fixture
def fleet(smoke_root: Path) -> Fleet:
    return fleet_slip.open(smoke_root)
