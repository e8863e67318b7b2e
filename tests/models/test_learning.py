"""Stacked models: a first-stage model whose estimate is an input of a second."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalog.catalog import FirstStageModel, integer_combination
from fleet_slip.catalog.definitions import Combination
from fleet_slip.columns.drive_columns import ColumnPlan, compute_columns
from fleet_slip.errors import DataError, QuestionError, StorageError
from fleet_slip.export.files import program_content
from fleet_slip.export.stepping import compile_program, make_checks
from fleet_slip.grams.compute import read_drives
from fleet_slip.grams.update import update_grams
from fleet_slip.models.registry import ModelVersion
from tests.export import plain
from tests.support.catalog import CATALOG, SIGNALS

INNER = ("ay_mean_16", "curvature_mean_8", "steering_mean_16")
SET = """\
[sets.tiny]
description = "A line's estimate, and what its error tells"
signals = ["ay", "yaw_rate"]
windows = ["curvature_mean_8", "steering_mean_16", "line", "error_slope"]
"""
LISTS = {
    "inner": f"""\
description = "Three columns"
features = "windows"
[[model]]
name = "three"
signals = {json.dumps(INNER)}
""",
    "outer": """\
description = "With what the line tells"
features = "tiny"
line = "inner"
[folds]
by = "drive"
count = 4
[[model]]
name = "all"
signals = ["ay", "curvature_mean_8", "line", "error_slope"]
""",
}


@pytest.fixture(scope="module")
def own_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Configs of one's own with the set `tiny`, and lists of models of it."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "models").mkdir()
    (folder / "features.toml").write_text(SET)
    for name, text in LISTS.items():
        (folder / "models" / f"{name}.toml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def filled_root(tmp_path_factory: pytest.TempPathFactory, smoke_root: Path, own_set: Path) -> Path:
    """A root with the model `tiny`. Copy it."""
    root = shutil.copytree(smoke_root, tmp_path_factory.mktemp("tiny") / "data")
    published(fleet_slip.open(root, own_set))
    return root


@pytest.fixture
def fleet(tmp_path: Path, filled_root: Path, own_set: Path) -> Fleet:
    return fleet_slip.open(shutil.copytree(filled_root, tmp_path / "data"), own_set)


def published(fleet: Fleet) -> ModelVersion:
    return fleet.models.publish("tiny", fleet.cohort().select(models="outer")).version


def the_line(fleet: Fleet) -> FirstStageModel:
    (digest,) = fleet.warehouse.stacked_models.digests()
    line = fleet.warehouse.stacked_models.find(digest)
    assert line is not None
    return line


def test_each_drive_has_the_estimate_of_a_line_that_was_fitted_without_it(fleet: Fleet) -> None:
    """By numpy's least squares on the rows themselves."""
    line, label = the_line(fleet), SIGNALS.label
    names = (*INNER, label)
    plan = ColumnPlan.from_definitions(
        names, {}, {n: CATALOG.time_columns[n].definition for n in INNER}
    )
    rows = {
        str(drive.facts["drive_id"]): compute_columns(plan, drive)
        for file in fleet.warehouse.logs.snapshot().files
        for drive in read_drives(fleet.warehouse, file, plan)
    }
    grams = fleet.sql(
        "SELECT drive_id, row_count, sums, signals FROM grams "
        f"WHERE feature_set LIKE 'tiny_{line.digest}%'"
    )
    folds = {drive: line.fold_of(drive) for drive in rows}
    assert len(set(folds.values())) == len(line.folds) > 2
    gram_rows = grams.to_arrow_table().to_pylist()
    assert len(gram_rows) == len(rows) > 4
    for gram in gram_rows:
        other_folds = [rows[d] for d in rows if folds[d] != folds[gram["drive_id"]]]
        training = np.hstack(other_folds)
        training = training[:, np.isfinite(training).all(axis=0)]
        inputs = np.vstack([training[:-1], np.ones(training.shape[1])])
        fitted, *_ = np.linalg.lstsq(inputs.T, training[-1], rcond=None)
        drive_rows = rows[gram["drive_id"]]
        drive_rows = drive_rows[:, np.isfinite(drive_rows).all(axis=0)]
        micro_rad = (
            fitted[:-1] @ drive_rows[:-1] + fitted[-1]
        ) * 100  # a count of the label is 0.0001
        total = gram["sums"][gram["signals"].split(",").index("line")]
        assert abs(total / gram["row_count"] - micro_rad.mean()) < 0.6


def test_a_version_is_the_same_on_board(fleet: Fleet) -> None:
    version = fleet.models.get("tiny")
    manifest, line = version.manifest, the_line(fleet)
    assert manifest.trained_on.feature_set.startswith(f"tiny_{line.digest}-")
    estimate = manifest.definitions["line"].made
    assert isinstance(estimate, Combination)
    assert (estimate.terms, estimate.line) == (line.fitted.terms, line.digest)
    assert manifest.first_stage_digest == line.digest
    program = compile_program(fleet.warehouse.catalog, manifest)
    for check in make_checks(fleet.warehouse.catalog, manifest, program):
        content, samples = program_content(program), list(check.samples)
        angles = plain.angles(content, list(check.facts), list(check.numbers), samples)
        assert angles == list(check.angles)
    assert len(version.manifest.model_dump_json()) < 40_000  # what is made stands once


def test_published_again_nothing_is_computed_again(fleet: Fleet) -> None:
    first = fleet.models.get("tiny")
    version = fleet.warehouse.grams.snapshot().version
    assert published(fleet) == first
    assert fleet.models.publish("tiny").version == first
    assert fleet.warehouse.grams.snapshot().version == version
    assert len(fleet.warehouse.stacked_models.digests()) == 1


def test_the_line_is_fitted_again_where_a_drive_of_it_is_gone(fleet: Fleet) -> None:
    line = the_line(fleet)
    ((drive,),) = fleet.sql("SELECT min(drive_id) FROM drives").fetchall()
    fleet.maintenance.forget(drive=drive)
    after = published(fleet).manifest.trained_on.feature_set
    assert line.digest not in after
    new_digests = set(fleet.warehouse.stacked_models.digests()) - {line.digest}
    (digest,) = new_digests
    fitted = fleet.warehouse.stacked_models.find(digest)
    assert fitted is not None
    assert fitted.drives == line.drives - 1


def test_a_drive_too_long_for_its_slope_is_refused(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On board a slope adds up no more from then on: the two would differ."""
    version = fleet.models.get("tiny")
    monkeypatch.setattr("fleet_slip.columns.drive_columns.most_products", lambda _: 1000)
    with pytest.raises(DataError, match="too many for windows"):
        fleet.evaluation.score(version)


def test_counts_of_another_grain_need_another_line(
    fleet: Fleet, tmp_path: Path, own_set: Path
) -> None:
    """A line of micro-radians is none of ten of them."""
    line = the_line(fleet)
    estimate = '\n[estimates.line]\nscale = 0.00001\ncolumn = "line_rad"\ndescription = "coarser"\n'
    configs = shutil.copytree(own_set, tmp_path / "own")
    (configs / "features.toml").write_text(SET + estimate)
    fleet = fleet_slip.open(fleet.root, configs)
    with pytest.raises(QuestionError, match=r"counts of 0\.000001 rad"):
        update_grams(fleet.warehouse, feature_set=f"tiny_{line.digest}")
    assert f"tiny_{line.digest}" not in fleet.warehouse.feature_sets()
    fleet.cohort().select(models="outer")
    assert len(fleet.warehouse.stacked_models.digests()) == 2


def test_a_line_that_was_changed_is_refused(fleet: Fleet, own_set: Path) -> None:
    line = the_line(fleet)
    file = Path(str(fleet.root)) / "lines" / line.digest / "1.json"
    file.write_text(file.read_text().replace('"drives": ', '"drives": 1', 1))
    with pytest.raises(StorageError, match="SHA-256"):
        published(fleet_slip.open(fleet.root, own_set))


def test_a_set_without_its_line_has_no_rows(fleet: Fleet) -> None:
    with pytest.raises(QuestionError, match="first-stage model, which is not fitted"):
        update_grams(fleet.warehouse, feature_set="tiny")
    with pytest.raises(QuestionError, match="choose a model list"):
        fleet.cohort().select(features="tiny", model="ay")
    with pytest.raises(QuestionError, match="the first-stage model 0123456789ab is not"):
        update_grams(fleet.warehouse, feature_set="tiny_0123456789ab")


def test_a_line_whose_estimate_would_not_be_exact_is_refused() -> None:
    column = CATALOG.time_columns["ay_mean_16"].definition
    scale = CATALOG.input_scales["ay"]
    with pytest.raises(QuestionError, match="exact"):
        integer_combination(scale, [scale * 2**40], [column])


def test_a_root_is_not_asked_for_the_lines_of_another(
    fleet: Fleet, smoke_root: Path, own_set: Path
) -> None:
    line = the_line(fleet)
    other = fleet_slip.open(smoke_root, own_set)
    missing = f"the first-stage model {line.digest} is not in this data root"
    with pytest.raises(QuestionError, match=missing):
        other.warehouse.catalog.first_stage_model(f"tiny_{line.digest}")
    assert fleet.warehouse.catalog.first_stage_model(f"tiny_{line.digest}") == line
