"""A model with gates from the command line: selected, published, scored and evaluated."""

import shutil
from pathlib import Path

import pytest

from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.models.registry import Registry
from fleet_slip.regression.folds import error_sums
from fleet_slip.regression.least_squares import fit
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.once import made_once
from tests.support.reported import answer

PLAIN = "ay_mean_16, curvature_mean_8, steering_mean_16, rear_ay_mean_16, course_sum_64"
LIST = """\
description = "With gates and without"
features = "gated"
tolerance = "0.0001deg"
[folds]
by = "drive"
count = 2
[[model]]
name = "plain"
signals = [{plain}]
[[model]]
name = "gated"
signals = [{plain}, "ax_mean", "yaw_rate_mean", {gates}]
"""


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("lists") / "gates.toml"
    plain = ", ".join(f'"{name}"' for name in PLAIN.split(", "))
    low = [name for name in CATALOG.members("excess") if name.endswith(("_1", "_2"))]
    gates = ", ".join(f'"{name}"' for name in low)  # the drives are too gentle for the upper knots
    file.write_text(LIST.format(plain=plain, gates=gates))
    return file


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path, models: Path) -> Path:
    def make(root: Path) -> None:
        shutil.copytree(smoke_root, root)
        update_grams(Warehouse(LocalFolder(root)), feature_set="gated")
        answer(root, "publish", "roads", "--models", str(models))

    return made_once(tmp_path_factory, "gated_model", make)


def test_gates_stand_in_the_manifest_as_they_are_defined(root: Path) -> None:
    manifest = Registry(LocalFolder(root), CATALOG).resolve("roads").manifest
    gates = [term.definition.gate for term in manifest.terms if term.definition]
    opened = [gate for gate in gates if gate]
    assert {gate.by.of for gate in opened} == {"steering_excess"}
    assert manifest.selected_by.model == "gated"
    assert len(opened) == 2 * len(CATALOG.file.gates["excess"].columns)


def test_score_finds_the_error_that_the_gram_rows_say(root: Path) -> None:
    """Every row of every drive, computed again from the logs, against sums of Gram rows."""
    warehouse = Warehouse(LocalFolder(root))
    manifest = Registry(LocalFolder(root), CATALOG).resolve("roads").manifest
    cohort = load_cohort(warehouse, "true", "gated")
    total = cohort.complete_cases(manifest.signals).table.total()
    fitted = fit(total, manifest.signals, manifest.label.signal)
    figures = error_sums(fitted.model, total).figures(SIGNALS[manifest.label.signal].exact_scale)
    scored = answer(root, "score", "roads", "--cohort", "true")
    assert scored["rows"] == figures.rows
    assert scored["rmse_deg"] == pytest.approx(figures.rmse_deg, rel=1e-9)
