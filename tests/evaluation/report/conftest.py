"""One small warehouse with an evaluation and its report, made once."""

import shutil
from pathlib import Path

import pytest

from fleet_slip.evaluation.kept import ReportData, gather
from fleet_slip.models.registry import Registry
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
from tests.support.once import made_once
from tests.support.reported import Reported, call

SCENARIOS = (
    "nominal",
    "noise_doubled",
    "adhesion_0_4",
    "adhesion_0_7",
    "gps_tunnel",
)


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path, tuned: Path) -> Reported:
    def make(root: Path) -> None:
        shutil.copytree(smoke_root, root)
        shutil.copytree(tuned, root / "tuned")
        options = [word for name in SCENARIOS for word in ("--scenario", name)]
        call(root, "evaluate", "smoke", *options)
        call(root, "report", "smoke")

    return Reported(made_once(tmp_path_factory, "reported", make))


@pytest.fixture(scope="session")
def data(reported: Reported) -> ReportData:
    version = Registry(LocalFolder(reported.root / "models")).resolve("smoke")
    return gather(Warehouse(LocalFolder(reported.root)), version)
