"""What changes of the course tell of a car: its figures, and what is no course."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fleet_slip.catalogue.course import CourseRelation, relate

Rows = NDArray[np.float64]
LEVER_M, COMPLIANCE, SPEED = 1.4, -0.005, 18.0
NOISE_MPS = 0.05


def changes(scale: float = 1.0, slip: float = 1.0, rows: int = 2000) -> Rows:
    """Return columns 1, curvature, ay, yaw rate, turned, label of a car at changing speeds."""
    rng = np.random.default_rng(7)
    curvature = 0.01 * rng.standard_normal(rows)
    speed = SPEED + 4 * rng.standard_normal(rows)
    yaw_rate, turned = curvature * speed, 0.5 * rng.standard_normal(rows)
    ay = yaw_rate * speed
    label = slip * (LEVER_M * curvature + COMPLIANCE * ay) + (scale - 1) * turned + 0.01
    label += np.sqrt(2) * NOISE_MPS / SPEED * rng.standard_normal(rows)
    return np.stack([np.ones(rows), curvature, ay, yaw_rate, turned, label])


def related(rows: Rows, delay_s: float = 0.0) -> CourseRelation:
    found = relate(rows @ rows.T, delay_s)
    assert found is not None
    return found


def test_a_car_is_found_as_it_is() -> None:
    found = related(changes(scale=1.02))
    assert found.scale == pytest.approx(1.02, abs=2e-3)
    assert found.lever_m == pytest.approx(LEVER_M, abs=0.1)
    assert found.compliance == pytest.approx(COMPLIANCE, abs=3e-4)
    assert found.noise_mps == pytest.approx(NOISE_MPS, rel=0.1)
    assert found.fault is None and found.misplaced is None


def test_a_heading_has_no_slip_and_another_place_another_lever() -> None:
    fault = related(changes(slip=0.0)).fault
    assert fault is not None and fault.kind == "no slip" and "heading" in fault.remedy
    for shift in (-1.5, 1.6):
        rows = changes()
        rows[5] += shift * rows[1]
        found = related(rows)
        assert found.fault is None and found.misplaced is not None
        assert "antenna" in found.misplaced.remedy


def test_a_delay_that_is_known_is_no_other_place() -> None:
    rows = changes()
    rows[5] -= 0.1 * rows[3]
    assert related(rows).misplaced is not None
    assert related(rows, 0.1).misplaced is None
    assert related(rows, 0.1).lever_m == pytest.approx(LEVER_M, abs=0.1)


@pytest.mark.parametrize(
    ("spoil", "kind"),
    [
        (lambda rows: rows[5] - 2 * rows[4], "reversed"),
        (lambda rows: rows[5] - rows[4], "stuck"),
        (lambda rows: rows[5] + 0.15 * rows[4], "scaled"),
        (lambda rows: np.roll(rows[5], 7) * 8, "noisy"),
    ],
)
def test_what_is_no_course_is_named(spoil: Callable[[Rows], Rows], kind: str) -> None:
    rows = changes()
    rows[5] = spoil(rows)
    fault = related(rows).fault
    assert fault is not None and fault.kind == kind


def test_little_driving_tells_nothing() -> None:
    few = changes(rows=90)
    assert relate(few @ few.T) is None
    straight = changes()
    straight[4] *= 1e-3
    assert relate(straight @ straight.T) is None
