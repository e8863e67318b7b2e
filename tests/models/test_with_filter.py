"""`--with-filter`: a model is combined with a Kalman filter in the identified car."""

from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.evaluation import filter_column, measured_evaluation
from fleet_slip.evaluation.ekf import EkfNoise
from fleet_slip.evaluation.evaluated_drives import QUARTERS, LabelledDrive, Segments
from fleet_slip.evaluation.identify import FitParameters, IdentifiedVehicle, vehicle_with_fit
from fleet_slip.evaluation.measured_evaluation import MAX_GROUPS, inner_groups
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.models.acceptance import load_thresholds, threshold_violations
from fleet_slip.models.manifest import LINE_ALONE
from fleet_slip.models.registry import ModelVersion
from fleet_slip.regression.combination import (
    CombinationChoice,
    PairedEstimates,
    choose_combination,
)
from fleet_slip.vehicle.parameters import VehicleMeasures
from tests.support.catalog import CATALOG
from tests.support.commands import done_on
from tests.support.measured import OWN_MAPPING, ingest_own
from tests.support.reported import answer

SHORT_LIST = """description = "One model"
[folds]
by = "drive"
count = 3
[[model]]
name = "1"
signals = ["ay", "yaw_rate"]
"""

CAR = "mass_kg = 1480\nfront_axle_m = 1.11\nrear_axle_m = 1.67\n"


def usual_car(
    measures: VehicleMeasures, drives: Sequence[LabelledDrive], *_: object, **__: object
) -> IdentifiedVehicle:
    """Return a car without a search, which takes seconds."""
    assert any(np.isfinite(drive.sideslip_rad).any() for drive in drives)
    return IdentifiedVehicle(vehicle_with_fit(measures), EkfNoise(), 0.0, fit=FitParameters())


@pytest.fixture
def car(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(filter_column, "identify", usual_car)
    monkeypatch.setattr(measured_evaluation, "identify", usual_car)
    file = tmp_path / "car.toml"
    file.write_text(CAR)
    return file


def test_a_version_with_a_filter_is_used_as_any_other(
    smoke_copy: Path, car: Path, tmp_path: Path
) -> None:
    published = done_on(
        smoke_copy, "publish", "both", "--models", "table1", "--with-filter", car, "--force"
    )
    assert "published both@1" in published.stderr
    assert "inner groups" in published.stderr, "which estimate is used where"
    version: ModelVersion = fleet_slip.open(smoke_copy).models.get("both")
    combination = version.manifest.combination
    assert combination is not None
    assert combination.method != "line"
    assert combination.measures.mass_kg == 1480
    strict = load_thresholds(CATALOG.configs).model_copy(update={"max_rmse_deg": 1e-6})
    assert "without the filter, its RMSE" in str(
        threshold_violations(strict, version.manifest, None)
    )
    shown = done_on(smoke_copy, "show", "both").stdout
    assert "with filter" in shown
    assert "both@1: line = intercept" in shown
    assert "deg, of the linear model alone" in shown
    assert LINE_ALONE in done_on(smoke_copy, "diagnose", "both").stderr
    assert "% of the difference to the linear model, clipped at" in " ".join(shown.split())
    assert "inner groups" in shown
    assert answer(smoke_copy, "score", "both")["rmse_deg"] < 1
    done_on(smoke_copy, "export", "both", "--to", "c", "--output", tmp_path / "c")
    assert answer(smoke_copy, "publish", "both")["new"] is False, "it is trained as it was"
    done_on(smoke_copy, "publish", "line", "--models", "table1", "--force")
    assert LINE_ALONE not in done_on(smoke_copy, "diagnose", "line").stderr
    (tmp_path / "short.toml").write_text(SHORT_LIST)
    again: list[str | Path] = [
        "publish",
        "both",
        "--models",
        tmp_path / "short.toml",
        "--dry-run",
        "--force",
    ]
    reviewed = " ".join(done_on(smoke_copy, *again).stderr.split())
    assert LINE_ALONE in reviewed
    facts = answer(smoke_copy, "diff", "both", "line")["facts"]
    assert facts["combination.method"] == {"one": combination.method, "other": None}


def test_without_a_signal_of_the_filter_the_line_stays_with_the_reason(
    tmp_path: Path, car: Path
) -> None:
    ingest_own(tmp_path / "data", tmp_path, cars=4)
    done_on(tmp_path / "data", "publish", "own", "--with-filter", car, "--force")
    combination = fleet_slip.open(tmp_path / "data").models.get("own").manifest.combination
    assert combination is not None
    assert (combination.method, combination.term) == ("line", None)
    assert (
        "The linear model alone: the drive has no"
        in done_on(tmp_path / "data", "show", "own").stdout
    )


def test_measures_of_a_mapping_train_with_a_filter_and_change_no_drive(tmp_path: Path) -> None:
    plain, with_car = tmp_path / "plain.toml", tmp_path / "with_car.toml"
    plain.write_text(OWN_MAPPING)
    with_car.write_text(f"{OWN_MAPPING}\n[vehicle]\n{CAR}")
    mappings = [load_mapping(str(file), CATALOG) for file in (plain, with_car)]
    assert mappings[0].canonical_json() == mappings[1].canonical_json()
    assert mappings[1].vehicle is not None
    assert mappings[1].vehicle.rear_axle_m == 1.67


def test_every_estimate_of_a_group_comes_from_fits_without_it(
    smoke_copy: Path, car: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[set[str]] = []

    def record(
        measures: VehicleMeasures, drives: Sequence[LabelledDrive], executor: Executor, **_: object
    ) -> IdentifiedVehicle:
        trained.append({drive.name for drive in drives})
        return usual_car(measures, drives)

    pairs: list[PairedEstimates] = []
    monkeypatch.setattr(filter_column, "identify", record)
    monkeypatch.setattr(measured_evaluation, "identify", record)

    def choose(estimates: PairedEstimates, kinds: PairedEstimates | None) -> CombinationChoice:
        pairs.append(estimates)
        return choose_combination(estimates, kinds)

    monkeypatch.setattr(measured_evaluation, "choose_combination", choose)
    done_on(smoke_copy, "publish", "both", "--models", "table1", "--with-filter", car, "--force")
    outer, *inner = trained
    assert len(inner) >= len(pairs[0].groups) > 1
    assert all(names < outer for names in inner)


def test_inner_groups_never_contain_what_is_held_out() -> None:
    class Drive:
        def __init__(self, name: str) -> None:
            self.name, self.trip, self.kind = name, name, "kind"

    drives = [Drive(f"drive {number}") for number in range(6)]
    held_out: Segments = frozenset(("drive 0", quarter) for quarter in range(QUARTERS))
    groups, kinds = inner_groups(drives, held_out)  # type: ignore[arg-type]
    assert kinds == [], "all are of one kind"
    assert len(groups) == MAX_GROUPS
    assert not any(group & held_out for group in groups)
    assert len(frozenset().union(*groups)) == 5 * QUARTERS
    quarters, _ = inner_groups(drives[:1], frozenset([("drive 0", 3)]))  # type: ignore[arg-type]
    assert quarters == [frozenset([("drive 0", quarter)]) for quarter in range(3)]
