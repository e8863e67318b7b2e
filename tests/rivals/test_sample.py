"""A sample has the columns of the Gram rows, and a rival sees the same on a test drive."""

from pathlib import Path

import numpy as np
import pytest

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.rivals.inputs import Inputs, LearnedEstimate
from fleet_slip.rivals.learner import Fitted
from fleet_slip.rivals.sample import draw_sample
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse

WINDOWS = ("ay_mean_16", "course_sum_16")
SIGNALS = ("ay", "yaw_rate")


def inputs() -> Inputs:
    """Return two signals and two windows."""
    return Inputs.of_catalogue((*SIGNALS, *WINDOWS))


@pytest.fixture
def warehouse(smoke_root: Path) -> Warehouse:
    return Warehouse(LocalFolder(smoke_root))


def test_a_sample_has_what_sql_makes_of_the_columns(warehouse: Warehouse, smoke_root: Path) -> None:
    cohort = load_cohort(warehouse, "campaign = 'smoke'")
    sample = draw_sample(warehouse, cohort, inputs(), rows=1000)
    assert sample.names == (*SIGNALS, *WINDOWS)
    assert 700 < len(sample.inputs) < 2000
    assert set(sample.drive_id) == set(cohort.drives["drive_id"].to_pylist())
    drive_id = str(sample.drive_id[0])
    stride = cohort.rows // 1000
    assert stride >= 15
    with connect(smoke_root) as database:
        rows = database.sql(
            "SELECT ay_mps2, yaw_rate_rad_s, sideslip_rad FROM log WHERE drive_id = $id "
            "ORDER BY time_s",
            params={"id": drive_id},
        ).fetchnumpy()
    of_drive = sample.drive_id == drive_id
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
    estimate = LearnedEstimate(inputs(), Fitted(lambda rows: rows[:, 3], 0))
    drive_id = str(sample.drive_id[0])
    columns = [catalogue()[name].column for name in catalogue().inputs]
    with connect(smoke_root) as database:
        rows = database.sql(
            f"SELECT {', '.join(columns)} FROM log WHERE drive_id = $id ORDER BY time_s",
            params={"id": drive_id},
        ).fetchnumpy()
    signals = {name: np.ma.filled(values.astype(float), np.nan) for name, values in rows.items()}
    stride = cohort.rows // 1000
    np.testing.assert_array_equal(
        estimate(signals)[::stride], sample.inputs[sample.drive_id == drive_id, 3]
    )
