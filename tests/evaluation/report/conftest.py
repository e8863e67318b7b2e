"""One small warehouse with an evaluation and its report, made once."""

import shutil
from pathlib import Path

import pytest

from fleet_slip.evaluation.evaluation_document import ReportData
from fleet_slip.evaluation.report import gather
from fleet_slip.models.registry import Registry
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG
from tests.support.once import made_once
from tests.support.reported import Reported, call


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory, evaluated: Path) -> Reported:
    def make(root: Path) -> None:
        shutil.copytree(evaluated, root)
        call(root, "report", "smoke")

    return Reported(made_once(tmp_path_factory, "reported", make))


@pytest.fixture(scope="session")
def data(reported: Reported) -> ReportData:
    version = Registry(LocalFolder(reported.root), CATALOG).resolve("smoke")
    return gather(Warehouse(LocalFolder(reported.root)), version)
