"""Each data root has its own catalog and connection, whatever other roots are open."""

import pickle
import shutil
from pathlib import Path
from typing import Any

import pytest

from fleet_slip.catalog.catalog import FirstStageModel
from fleet_slip.catalog.definitions import Combination
from fleet_slip.errors import QuestionError, StorageError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.resources import folder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, configs_with
from tests.support.logs import ask, path_of
from tests.support.measured import a_mapping, csv_text, ingest_file

SHIPPED = (folder("configs") / "signals.toml").read_text(encoding="utf-8")
COARSE = SHIPPED.replace(
    "scale = 0.001\nmin = -30.0\nmax = 30.0", "scale = 0.002\nmin = -30\nmax = 30", 1
)
DOUBLED = """
[features.ax_doubled]
counts = "2 * ax"
scale = 0.001
unit = "m/s^2"
column = "ax_doubled_mps2"
description = "Twice the counts"

[sets.doubled]
description = "Twice the counts"
signals = ["ax"]
features = ["ax_doubled"]
"""
ROWS = 50


@pytest.fixture
def other(tmp_path: Path) -> Warehouse:
    """A root whose ax has another scale, and whose catalog has one more feature."""
    configs = configs_with(tmp_path / "configs", signals=COARSE, features=DOUBLED)
    return Warehouse(LocalFolder(tmp_path / "other"), configs)


def fill(warehouse: Warehouse, file: Path) -> None:
    """Ingest a log of 50 rows with ax = 0, 0.02, 0.04 ... m/s^2."""
    rising = [round(0.02 * row, 2) for row in range(ROWS)]
    columns: dict[str, Any] = {"t": [row / 100 for row in range(ROWS)], "ax": rising}
    file.write_text(csv_text(columns | {"beta": [0.1] * ROWS}), encoding="utf-8")
    ingest_file(warehouse, file, a_mapping(catalog=warehouse.catalog))


def contents(warehouse: Warehouse) -> dict[str, Any]:
    """Return what a root says of its columns."""
    return {
        "identities": [warehouse.catalog.identity(name) for name in ("motion", "signals")],
        "sets": warehouse.feature_sets(),
        "counts": ask(warehouse, "SELECT sum(ax) FROM log_counts"),
        "values": ask(warehouse, "SELECT round(sum(ax_mps2), 6) FROM log"),
        "grams": ask(warehouse, "SELECT feature_set, signals, sums FROM grams ORDER BY ALL"),
        "scale": ask(warehouse, "SELECT unit FROM dictionary WHERE \"column\" = 'ax' LIMIT 1"),
        "label": load_cohort(warehouse, "true").catalog.input_scales["ax"],
    }


def test_two_roots_in_one_process_have_each_their_own_results(
    warehouse: Warehouse, other: Warehouse, tmp_path: Path
) -> None:
    fill(warehouse, tmp_path / "log.csv")
    update_grams(warehouse)
    before = contents(warehouse)
    fill(other, tmp_path / "log.csv")
    update_grams(other)
    update_grams(other, feature_set="doubled")
    results = contents(other)
    assert contents(warehouse) == before, "opening another root changed an open one"
    total = sum(20 * row for row in range(ROWS))
    assert (before["counts"], results["counts"]) == ([(total,)], [(total // 2,)])
    assert before["values"] == results["values"] == [(pytest.approx(total / 1000),)]
    assert before["grams"][0][2][0] == total
    assert [(signals, sums[:2]) for _, signals, sums in results["grams"]] == [
        ("ax,ax_doubled,sideslip", [total // 2, total]),
        ("ax,sideslip", [total // 2, results["grams"][1][2][1]]),
    ]
    assert ("doubled" in before["sets"], "doubled" in results["sets"]) == (False, True)
    assert before["identities"][0] != results["identities"][0]
    assert (before["scale"], results["scale"]) == ([("0.001 m/s^2",)], [("0.002 m/s^2",)])
    with pytest.raises(QuestionError, match="no feature set is called 'doubled'"):
        update_grams(warehouse, feature_set="doubled")


def first_stage_model() -> FirstStageModel:
    estimate = next(iter(CATALOG.estimates))
    return FirstStageModel(
        estimate=estimate,
        fitted=Combination(),
        folds={},
        scale=CATALOG.estimates[estimate].scale,
        models="learning",
        feature_set="signals",
        models_sha256="0" * 64,
        cohort="true",
        drives=1,
        drive_hashes="0" * 16,
    )


def test_a_first_stage_model_belongs_to_its_root_until_that_is_closed(
    warehouse: Warehouse, other: Warehouse
) -> None:
    model = first_stage_model()
    name = f"{next(iter(CATALOG.stacked_sets))}_{model.digest}"
    warehouse.stacked_models.keep(model)
    assert warehouse.catalog.identity(name)
    for elsewhere in (other, Warehouse(other.root)):
        with pytest.raises(QuestionError, match="not in this data root"):
            elsewhere.catalog.identity(name)
    shutil.rmtree(path_of(warehouse.root) / "lines")
    assert warehouse.stacked_models.find(model.digest) == model, "it is read once"
    warehouse.close()
    with pytest.raises(StorageError, match="is missing"):
        warehouse.stacked_models.find(model.digest)


def test_a_worker_without_the_folder_of_configs_has_the_catalog(other: Warehouse) -> None:
    pickled = pickle.dumps(other)
    assert other.configs.folder is not None
    shutil.rmtree(other.configs.folder)
    sent = pickle.loads(pickled)  # noqa: S301 - of this test
    assert sent.catalog.signals["ax"].exact_scale == 2 * CATALOG.signals["ax"].exact_scale
    assert sent.catalog.identity("doubled") == other.catalog.identity("doubled")
    assert sent.catalog.first_stage_models is sent.stacked_models
