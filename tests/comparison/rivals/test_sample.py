"""A sample has the columns of the Gram rows, and a rival sees the same on a test drive."""

from pathlib import Path

import numpy as np
import pytest

from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.drive_columns import DriveColumns, DriveCounts
from fleet_slip.comparison.rivals.inputs import Inputs, LearnedEstimate, draw_sample
from fleet_slip.comparison.rivals.learner import FittedLearner
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.models.versions import Registry
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse
from tests.support.inputs_today import inputs_today

WINDOWS = ("ay_mean_16", "course_sum_16")
SIGNALS = ("ay", "yaw_rate")


def inputs() -> Inputs:
    """Return two signals and two windows."""
    return inputs_today((*SIGNALS, *WINDOWS))


@pytest.fixture
def warehouse(smoke_root: Path) -> Warehouse:
    return Warehouse(LocalFolder(smoke_root))


def test_a_sample_has_what_sql_makes_of_the_columns(warehouse: Warehouse, smoke_root: Path) -> None:
    cohort = load_cohort(warehouse, "campaign = 'smoke'")
    sample = draw_sample(warehouse, cohort, inputs(), rows=1000)
    assert sample.names == (*SIGNALS, *WINDOWS)
    assert 700 < len(sample.inputs) < 2000
    assert set(sample.trip) == set(cohort.drives["drive_id"].to_pylist())
    drive_id = str(sample.trip[0])
    stride = cohort.rows // 1000
    assert stride >= 15
    with connect(smoke_root) as database:
        rows = database.sql(
            "SELECT ay_mps2, yaw_rate_rad_s, sideslip_rad FROM log WHERE drive_id = $id "
            "ORDER BY time_s",
            params={"id": drive_id},
        ).fetchnumpy()
    of_drive = sample.trip == drive_id
    np.testing.assert_allclose(sample.inputs[of_drive, 0], rows["ay_mps2"][::stride], rtol=1e-9)
    np.testing.assert_allclose(
        sample.sideslip_rad[of_drive], rows["sideslip_rad"][::stride], rtol=1e-9, atol=1e-12
    )
    # A mean over 16 ticks, by hand.
    mean = np.convolve(rows["ay_mps2"], np.ones(16) / 16)[15 : len(rows["ay_mps2"])]
    found = sample.inputs[of_drive, 2]
    expected = mean[np.arange(len(found)) * stride - 15][1:]
    np.testing.assert_allclose(found[1:], expected, atol=2e-4)


def test_a_rival_sees_on_a_drive_what_it_was_trained_on(
    warehouse: Warehouse, smoke_root: Path
) -> None:
    """Its estimate is the window itself: the same number in a sample and on a drive."""
    cohort = load_cohort(warehouse, "campaign = 'smoke'")
    sample = draw_sample(warehouse, cohort, inputs(), rows=1000)
    estimate = LearnedEstimate(inputs(), FittedLearner(lambda rows: rows[:, 3], 0))
    drive_id = str(sample.trip[0])
    columns = [catalogue()[name].column for name in catalogue().inputs]
    with connect(smoke_root) as database:
        rows = database.sql(
            f"SELECT {', '.join(columns)} FROM log WHERE drive_id = $id ORDER BY time_s",
            params={"id": drive_id},
        ).fetchnumpy()
    signals = {name: np.ma.filled(values.astype(float), np.nan) for name, values in rows.items()}
    stride = cohort.rows // 1000
    np.testing.assert_array_equal(
        estimate(signals)[::stride], sample.inputs[sample.trip == drive_id, 3]
    )


def test_a_sample_has_the_numbers_that_a_cars_drives_tell(warehouse: Warehouse) -> None:
    cohort = load_cohort(warehouse, "campaign = 'smoke'")
    (car,) = set(cohort.drives["vehicle_id"].to_pylist())
    offset = inputs_today(("ay_offset_alone",))
    told = draw_sample(warehouse, cohort, offset, rows=500, numbers={car: {"ay_offset": 37}})
    number = features().time_columns["ay_offset_alone"].definition.number
    assert number is not None
    expected = (37 - number.less) * offset.scales["ay_offset_alone"]
    np.testing.assert_allclose(told.inputs, expected)
    running = draw_sample(warehouse, cohort, offset, rows=500, numbers={"another": {}})
    assert np.ptp(running.inputs) > 0


def test_of_a_gated_model_a_rival_sees_columns_and_what_opens_the_gates(smoke_root: Path) -> None:
    known = features()
    manifest = Registry(LocalFolder(smoke_root / "models")).resolve("smoke").manifest
    gated = [name for name in known.members("excess") if name.startswith("rear_ay_mean_16_")]
    assert len(gated) > 2
    first = manifest.terms[0]
    terms = tuple(
        first.model_copy(update={"signal": name, "definition": known.definition(name)})
        for name in ("rear_ay_mean_16", *gated)
    )
    found = Inputs.of_model(manifest.model_copy(update={"terms": terms}), SIGNALS)
    assert found.names == (*SIGNALS, "rear_ay_mean_16", "steering_excess_mean_32")
    generator = np.random.default_rng(6)
    counts = {name: generator.integers(2000, 6000, 40) for name in catalogue().inputs}
    drive = DriveCounts(np.arange(40), counts)
    alone = inputs_today(("rear_ay_mean_16", "steering_excess_mean_32"))
    expected = DriveColumns(alone.plan, drive).compute()
    assert (np.ptp(expected, axis=1) > 0).all()
    np.testing.assert_array_equal(DriveColumns(found.plan, drive).compute()[2:], expected)
