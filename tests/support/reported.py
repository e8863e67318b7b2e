"""A data root with its report, and the command line in this process."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from fleet_slip.arrays import FloatArray
from fleet_slip.cli.app import app
from fleet_slip.evaluation.identify import Coordinates, Optimum, minimize
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


SCENARIOS = tuple(
    word
    for name in (
        *("nominal", "noise_doubled", "adhesion_0_4", "adhesion_0_7", "gps_tunnel"),
        "wheel_missing",
    )
    for word in ("--scenario", name)
)
"""The test drives that are evaluated once, as words of a command."""

LITTLE_S = 4
"""So much of each drive filters are tuned on, and a car identified from: most of an evaluation."""


def briefly(
    residuals: Callable[[FloatArray], FloatArray],
    coordinates: Coordinates[Any],
    starts: Sequence[FloatArray],
) -> Optimum:
    """Search from the first begin alone, and not to the end."""
    return minimize(residuals, coordinates, starts[0], max_steps=2)


def call(root: Path, *words: str) -> str:
    """Run a command, its searches short; what stops it is raised."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fleet_slip.evaluation.filters.TUNING_S", LITTLE_S)
        patch.setattr("fleet_slip.evaluation.identify.minimize_from", briefly)
        result = CliRunner().invoke(app, ["--root", str(root), *words])
    require_no_failed_run(root)
    if result.exception is not None:
        raise result.exception
    return result.stdout


def answer(root: Path, *words: str) -> Any:
    """Return what a command says as JSON."""
    return json.loads(call(root, *words, "--json"))
