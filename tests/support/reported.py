"""A data root with its report, and the command line in this process."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from fleet_slip.cli.app import app
from tests.support.once import require_no_failed_run


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
    require_no_failed_run(root)
    if result.exception is not None:
        raise result.exception
    return result.stdout
