"""Which columns change sign where left and right are exchanged, by hand and by rows of a drive."""

import numpy as np
import pytest

from fleet_slip.catalogue.definitions import EXCHANGED, OPPOSITE, parity
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.drive_columns import DriveColumns, DriveCounts
from fleet_slip.columns.plan import ColumnPlan

ODD = (
    *("ay", "yaw_rate", "steering_wheel", "steer_fl", "curvature", "wheel_difference_rear"),
    *("ay_mean_16", "ay_square_mean_8", "ay_ax_mean_16", "steer_speed_mean_16", "rear_ay_mean_64"),
    *("ay_mean_16_cornering_1", "ay_mean_16_mass", "understeer_ay", "yaw_rate_offset_slowness"),
)
NOT_ODD = (
    *("ax", "wheel_fl", "speed", "ay_size", "ax_mean_16", "slowness", "wheel_difference_axles"),
    *("steering_excess", "ax_mean_16_cornering_1", "understeer_alone"),
)


@pytest.mark.parametrize("name", ODD)
def test_what_changes_sign(name: str) -> None:
    assert features().is_odd(name)


@pytest.mark.parametrize("name", NOT_ODD)
def test_what_does_not(name: str) -> None:
    assert not features().is_odd(name)


def test_a_gate_that_an_odd_column_opens_makes_a_column_of_neither_kind() -> None:
    one = features().time_columns["ay_mean_16_cornering_1"].definition
    assert one.gate is not None
    by_ay = one.gate.model_copy(update={"by": features().time_columns["ay_mean_32"].definition})
    assert parity(one) == -1 and parity(one.model_copy(update={"gate": by_ay})) == 0


def test_a_mirrored_drive_has_the_opposite_columns() -> None:
    """By the kernel that Gram rows come from, every column that a search among changes knows."""
    known = features()
    names = known.searched("course_gated")
    random = np.random.default_rng(1)
    drive = {name: random.integers(4000, 6000, 400) for name in catalogue().inputs}
    drive |= {name: random.integers(-3000, 3000, 400) for name in drive if name in OPPOSITE}
    other = {
        name: -drive[name] if name in OPPOSITE else drive[EXCHANGED.get(name, name)]
        for name in drive
    }
    windows = {
        name: known.time_columns[name].definition for name in names if name in known.time_columns
    }
    plan = ColumnPlan.of(names, known.rows(names), windows)

    def columns(counts: dict[str, np.ndarray]) -> np.ndarray:
        one = DriveCounts(np.arange(400), {n: c.astype(np.int16) for n, c in counts.items()})
        return DriveColumns(plan, one).compute()

    assert len(names) > 100
    assert np.array_equal(columns(drive), -columns(other), equal_nan=True)


def test_a_search_among_changes_knows_odd_and_short_columns_alone() -> None:
    found = features().searched("course")
    assert "ax" not in found and "wheel_fl" not in found and "curvature" not in found
    assert "ay_mean_128" in found and "ay_mean_256" not in found
    assert features().searched("windows") == features().feature_set("windows").inputs
