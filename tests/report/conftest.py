"""One small warehouse with an evaluation and its report, made once for all test processes."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from fleet_slip.cli.main import app
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.models.versions import Registry
from fleet_slip.report.data import ReportData, gather
from fleet_slip.warehouse.tables import Warehouse

SCENARIOS = (
    "nominal",
    "noise_doubled",
    "adhesion_0_4",
    "adhesion_0_7",
    "gps_tunnel",
    "style_gentle",
    "style_limit",
)


@dataclass(frozen=True)
class Reported:
    """A data root and the folder of its report."""

    root: Path

    @property
    def page(self) -> Path:
        return self.root / "report" / "report.html"

    @property
    def figures(self) -> Path:
        return self.root / "report" / "figures"


def call(root: Path, *words: str) -> Any:
    result = CliRunner().invoke(app, ["--root", str(root), *words])
    if result.exception is not None:
        raise result.exception
    return result.stdout


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    made = Reported(shared / "reported")
    with LocalFolder(shared).exclusive("reported.lock", lambda: None):
        if not made.page.exists():
            call(made.root, "run", "--campaign", "smoke")
            options = [word for name in SCENARIOS for word in ("--scenario", name)]
            call(made.root, "evaluate", "--one-car", "smoke", *options)
            call(made.root, "report", "--model", "smoke")
    return made


@pytest.fixture(scope="session")
def data(reported: Reported) -> ReportData:
    version = Registry(LocalFolder(reported.root / "models")).resolve("smoke")
    return gather(Warehouse(LocalFolder(reported.root)), version)
