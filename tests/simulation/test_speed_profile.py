"""Speed profiles: the limits hold, the profile is tight, and analytic cases agree."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleet_slip.simulation.roads import (
    Segment,
    SpeedLimits,
    SpeedProfile,
    Track,
    load_track,
    speed_profile,
)

TRACKS = {name: load_track(name) for name in ("waterford_hills", "melbourne", "skid_pad")}
S_BEND = Track(
    name="s_bend",
    description="open: a straight, a left and a right bend",
    closed=False,
    segments=(
        Segment(length_m=400, curvature_1pm=(0, 0)),
        Segment(length_m=40, curvature_1pm=(0, 0.03)),
        Segment(length_m=80, curvature_1pm=(0.03, -0.02)),
        Segment(length_m=40, curvature_1pm=(-0.02, 0)),
        Segment(length_m=300, curvature_1pm=(0, 0)),
    ),
)
TRACKS["s_bend"] = S_BEND

limit = st.floats(0.5, 12.0)
limits = st.builds(
    SpeedLimits,
    lateral_mps2=limit,
    acceleration_mps2=limit,
    braking_mps2=limit,
    top_speed_mps=st.floats(5.0, 70.0),
)


def accelerations(profile: SpeedProfile) -> NDArray[np.float64]:
    """Acceleration from each point to the next, (v₁² - v₀²) / 2Δs."""
    squared = profile.speed_mps**2
    if profile.track.closed:
        squared = np.append(squared, squared[0])
    return np.diff(squared) / (2 * profile.spacing_m)


@settings(max_examples=60)
@given(name=st.sampled_from(sorted(TRACKS)), plan=limits)
def test_friction_ellipse_holds_at_every_point(name: str, plan: SpeedLimits) -> None:
    profile = speed_profile(TRACKS[name], plan, 1.0)
    assert profile.speed_mps.min() > 0
    assert profile.speed_mps.max() <= plan.top_speed_mps * (1 + 1e-12)
    lateral = profile.track.curvature(profile.station_m) * profile.speed_mps**2
    assert np.all(np.abs(lateral) <= plan.lateral_mps2 * (1 + 1e-9))
    along = accelerations(profile)
    used = lateral / plan.lateral_mps2
    # A rise of speed is limited where it arrives, a fall where it begins.
    arrives = np.roll(used, -1)[: len(along)]
    begins = used[: len(along)]
    rising = np.maximum(along, 0) / plan.acceleration_mps2
    falling = np.minimum(along, 0) / plan.braking_mps2
    assert np.all(np.where(along > 0, rising**2 + arrives**2, 0) <= 1 + 1e-6)
    assert np.all(np.where(along < 0, falling**2 + begins**2, 0) <= 1 + 1e-6)


@settings(max_examples=40)
@given(
    name=st.sampled_from(sorted(TRACKS)),
    plan=limits,
    key=st.sampled_from(sorted(SpeedLimits.model_fields)),
    more=st.floats(1.0, 3.0),
)
def test_a_higher_limit_is_nowhere_slower(
    name: str, plan: SpeedLimits, key: str, more: float
) -> None:
    raised = plan.model_copy(update={key: getattr(plan, key) * more})
    slow = speed_profile(TRACKS[name], plan, 2.0).speed_mps
    fast = speed_profile(TRACKS[name], raised, 2.0).speed_mps
    assert np.all(fast >= slow * (1 - 1e-9))


@pytest.mark.parametrize("name", ["waterford_hills", "melbourne"])
def test_some_limit_is_reached_everywhere(name: str) -> None:
    plan = SpeedLimits(
        lateral_mps2=5.5, acceleration_mps2=2.5, braking_mps2=4.0, top_speed_mps=45.0
    )
    profile = speed_profile(TRACKS[name], plan, 1.0)
    used = np.abs(profile.track.curvature(profile.station_m)) * profile.speed_mps**2 / 5.5
    along = accelerations(profile)
    ellipse = np.maximum(
        np.hypot(np.maximum(along, 0) / 2.5, np.roll(used, -1)),
        np.hypot(np.minimum(along, 0) / 4.0, used),
    )
    saturated = (ellipse > 0.97) | (profile.speed_mps > 44.99) | (used > 0.97)
    # Points where driving turns into braking are the only ones between two limits.
    assert np.mean(saturated) > 0.97


def test_skid_pad_is_driven_at_the_root_of_lateral_acceleration_times_radius() -> None:
    plan = SpeedLimits(
        lateral_mps2=4.5, acceleration_mps2=2.0, braking_mps2=2.0, top_speed_mps=60.0
    )
    profile = speed_profile(TRACKS["skid_pad"], plan, 1.0)
    assert np.allclose(profile.speed_mps, np.sqrt(4.5 * 50.0))
    for laps in (0.25, 1, 2.5):
        assert profile.time_s(laps) == pytest.approx(laps * 314.159265 / 15.0)
