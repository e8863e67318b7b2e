"""Reading a drive from the view `log`, and filling gaps."""

from dataclasses import fields

import duckdb
import numpy as np
import pytest

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.evaluation.single_track import DriveSignals, hold_last, read_drive, sideslip_angle


@pytest.fixture
def database() -> duckdb.DuckDBPyConnection:
    """A table `log` of two drives of three rows, in no order; signal i of row k is i + k / 10."""
    connection = duckdb.connect(":memory:")
    names = [field.name for field in fields(DriveSignals)]
    columns = ", ".join(f"{i} + k / 10 AS {name}" for i, name in enumerate(names))
    connection.execute(
        f"CREATE TABLE log AS SELECT d AS drive_id, k / 100 AS time_s, {columns}, "
        "-k / 1000 AS sideslip_rad FROM range(3) r(k), (VALUES ('a'), ('b')) v(d) "
        "ORDER BY hash(k, d)"
    )
    connection.execute("UPDATE log SET gps_vx_mps = NULL, gps_vy_mps = NULL WHERE time_s > 0.005")
    return connection


def test_a_drive_is_read_in_order_with_nan_for_null(database: duckdb.DuckDBPyConnection) -> None:
    drive = read_drive(database, "b")
    assert drive.drive_id == "b"
    assert len(drive.signals) == 3
    np.testing.assert_allclose(drive.signals.ax_mps2, [0, 0.1, 0.2])
    np.testing.assert_allclose(drive.signals.steer_fr_rad, [8, 8.1, 8.2])
    np.testing.assert_array_equal(drive.signals.gps_vx_mps, [9, np.nan, np.nan])
    np.testing.assert_allclose(drive.sideslip_rad, [0, -0.001, -0.002])


def test_an_unknown_drive_is_refused(database: duckdb.DuckDBPyConnection) -> None:
    with pytest.raises(QuestionError, match="no drive is called 'c'"):
        read_drive(database, "c")


def test_gaps_take_the_value_before_and_a_leading_one_the_first() -> None:
    nan = np.nan
    values = np.array([nan, 2.0, nan, nan, 5.0, nan])
    assert hold_last(values, "ax").tolist() == [2, 2, 2, 2, 5, 5]
    whole = np.array([1.0, 2.0])
    assert hold_last(whole, "ax") is whole
    with pytest.raises(DataError, match="no ax"):
        hold_last(np.full(3, nan), "ax")


def test_angle_is_the_arctangent_and_goes_to_zero_with_vy_at_rest() -> None:
    vx = np.array([20.0, 1.0, 0.0, -0.01, np.nan])
    vy = np.array([-1.0, 0.1, 0.1, 0.0, 1.0])
    expected = [np.arctan(-1 / 20), np.arctan(0.1), np.arctan(0.1), 0.0, np.nan]
    np.testing.assert_allclose(sideslip_angle(vx, vy), expected, rtol=1e-15)
