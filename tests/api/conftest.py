"""A data root with models, made once for all tests of the Python API."""

import shutil
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from tests.support.commands import done_on
from tests.support.model_lists import nested, write_list
from tests.support.once import made_once

FEATURES = "ay,yaw_rate,steering_wheel,speed_squared,curvature,course_rate,ay_signed_square"


@pytest.fixture(scope="session")
def bent_root(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path) -> Path:
    """The campaign `smoke`, its model, and a model with features called `bent`."""

    def make(root: Path) -> None:
        shutil.copytree(smoke_root, root)
        done_on(root, "gram", "--features", "motion")
        list_path = write_list(root.with_name("bent.toml"), *nested(FEATURES), features="motion")
        done_on(root, "publish", "bent", "--models", list_path)

    return made_once(tmp_path_factory, "bent", make)


@pytest.fixture
def fleet(bent_root: Path) -> Fleet:
    return fleet_slip.open(bent_root)
