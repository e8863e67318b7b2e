"""A model's fit examined against the rows, and how much of its error is noise of the label."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip import open as open_fleet
from fleet_slip.errors import ConfigError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.models.diagnose import diagnose
from fleet_slip.models.publish import manifest_of
from fleet_slip.models.select import label_noise_deg
from fleet_slip.resources import Configs
from fleet_slip.storage.local import LocalFolder
from fleet_slip.views import connect
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG
from tests.support.counts import INPUTS, LABEL, by_rows, cohort_of, dense_fit, driven, rows_of

COEFFICIENTS = (0.1, 0.4, 0.9, 0.2)


def test_figures_are_those_of_the_rows() -> None:
    drives = driven(1, COEFFICIENTS)
    diagnosis = diagnose(cohort_of(drives), INPUTS)
    rows = rows_of(drives).astype(float)
    b, rss = dense_fit(rows)
    scales = CATALOG.input_scales
    units = [float(scales[LABEL] / scales[name]) for name in INPUTS]
    slopes = [estimate.value for estimate in diagnosis.naive.estimates[1:]]
    np.testing.assert_allclose(slopes, b[1:] * units, rtol=1e-9)
    assert [e.value for e in diagnosis.robust.estimates] == [
        e.value for e in diagnosis.naive.estimates
    ]
    deviation = np.sqrt(rss / (len(rows) - 5)) * float(scales[LABEL])
    assert diagnosis.naive.residual_std == pytest.approx(deviation, rel=1e-9)
    correlations = np.corrcoef(rows[:, :-1].T)
    inflation = np.diag(np.linalg.inv(correlations))
    np.testing.assert_allclose([diagnosis.inflation[name] for name in INPUTS], inflation, rtol=1e-9)
    assert diagnosis.condition_number == pytest.approx(np.linalg.cond(correlations), rel=1e-9)
    assert (diagnosis.drives, diagnosis.fitted.gram.n) == (12, len(rows))
    document = diagnosis.as_dict()
    assert document["rows"] == len(rows)
    assert document["design_effect"] == diagnosis.evidence.design_effect


def test_cars_are_independent_and_the_drives_of_a_single_car() -> None:
    """Against matrices of all rows, with the cars or the drives as clusters."""
    drives = driven(9, COEFFICIENTS, drives=22, rows=30)
    cohort = cohort_of(drives)
    owners = cohort.drives["vehicle_id"].to_pylist()
    at = cohort.drives.schema.get_field_index("vehicle_id")
    one_car = cohort.drives.set_column(at, "vehicle_id", pa.array(["a"] * len(drives)))
    of_one = replace(cohort, drives=one_car)
    units = [float(CATALOG.input_scales[LABEL] / CATALOG.input_scales[name]) for name in INPUTS]
    names = [drive.drive for drive in drives]
    for cluster, groups, read in (("vehicle", owners, cohort), ("drive", names, of_one)):
        parts = [
            rows_of(
                [
                    d
                    for d, group_of_drive in zip(drives, groups, strict=True)
                    if group_of_drive == group
                ]
            )
            for group in sorted(set(groups))
        ]
        expected, degrees = by_rows(parts)
        diagnosis = diagnose(read, INPUTS)
        assert diagnosis.cluster == cluster
        slopes = diagnosis.robust.estimates[1:]
        errors = [estimate.standard_error for estimate in slopes]
        np.testing.assert_allclose(errors, expected[1:] * units, rtol=1e-7)
        of_t = [estimate.degrees_of_freedom for estimate in slopes]
        np.testing.assert_allclose(of_t, degrees[1:], rtol=1e-6)
        assert diagnosis.robust.degrees_of_freedom == len(set(groups)) - 1
        assert diagnosis.evidence.kind == f"{cluster}s"


def test_the_campaigns_noise_is_what_the_label_differs_from_the_truth_by(smoke_root: Path) -> None:
    warehouse = Warehouse(LocalFolder(smoke_root))
    stated = label_noise_deg(warehouse, load_cohort(warehouse))
    with connect(smoke_root, query="log") as database:
        off = database.sql(
            "SELECT degrees(sideslip_rad - atan2(vy_mps, vx_mps)) AS off FROM log "
            "WHERE source = 'simulated' AND vx_mps > 15"
        ).fetchnumpy()["off"]
    step = math.degrees(0.005 / math.sqrt(12) / 20)  # of the true vy in the log
    assert stated == pytest.approx(math.sqrt(np.var(off) - step**2), rel=0.02)


def test_a_selection_and_its_manifest_tell_it(smoke_root: Path) -> None:
    selection = open_fleet(smoke_root).cohort().select(model="ay,yaw_rate")
    noise = math.degrees(math.hypot(0.0005, 0.0001 / math.sqrt(12)))
    assert selection.as_dict()["label_noise_deg"] == pytest.approx(noise)
    figures = manifest_of(selection, "told").cross_validation
    assert figures.label_noise_deg == pytest.approx(noise)
    assert math.hypot(figures.beyond_label_noise_deg, noise) == pytest.approx(figures.rmse_deg)
    assert selection.beyond_label_noise_deg == figures.beyond_label_noise_deg


def test_nobody_knows_the_noise_of_a_campaign_that_is_not_there(
    smoke_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def find(_: Configs, kind: str, name: str) -> Path:
        raise ConfigError(f"{kind}: nothing is called {name!r}.")

    monkeypatch.setattr(Configs, "find", find)
    warehouse = Warehouse(LocalFolder(smoke_root))
    assert label_noise_deg(warehouse, load_cohort(warehouse)) is None
