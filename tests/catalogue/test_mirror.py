"""Which columns change sign where left and right are exchanged, by rows of a drive."""

import numpy as np
import pytest

from fleet_slip.catalogue.definitions import EXCHANGED, OFFSETS, OPPOSITE, parity
from fleet_slip.catalogue.facts import CAR_NUMBERS
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.drive_columns import DriveColumns, DriveCounts
from fleet_slip.columns.plan import ColumnPlan


def test_a_gate_that_an_odd_column_opens_makes_a_column_of_neither_kind() -> None:
    one = features().time_columns["ay_mean_16_cornering_1"].definition
    assert one.gate is not None
    by_ay = one.gate.model_copy(update={"by": features().time_columns["ay_mean_32"].definition})
    assert parity(one) == -1 and parity(one.model_copy(update={"gate": by_ay})) == 0


@pytest.mark.parametrize("name", ["windows", "course_gated", "fleet"])
def test_what_is_odd_has_the_opposite_columns_in_a_mirrored_drive(name: str) -> None:
    """By the kernel that Gram rows come from, every column of the set; no other one is odd."""
    known = features()
    names = known.feature_set(name).inputs
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

    def columns(counts: dict[str, np.ndarray], offset: int) -> np.ndarray:
        numbers: dict[str, int] = {name: offset if name in OFFSETS else 500 for name in CAR_NUMBERS}
        whole = {name: values.astype(np.int16) for name, values in counts.items()}
        facts = {"mass_kg": 1400.0, "vehicle_model": "suv"}
        return DriveColumns(
            plan, DriveCounts(np.arange(400), whole, numbers=numbers, facts=facts)
        ).compute()

    found = [
        (name, np.array_equal(one, -two, equal_nan=True))
        for name, one, two in zip(names, columns(drive, 300), columns(other, -300), strict=True)
        if np.nan_to_num(one).any()  # a gate that stays closed has no sign
    ]
    assert 10 < sum(is_opposite for _, is_opposite in found) < len(found)
    assert found == [(name, known.is_odd(name)) for name, _ in found]


def test_a_search_among_changes_knows_odd_and_short_columns_alone() -> None:
    found = features().searched("course")
    assert "ax" not in found and "wheel_fl" not in found and "curvature" not in found
    assert "ay_mean_128" in found and "ay_mean_256" not in found
    assert features().searched("windows") == features().feature_set("windows").inputs
