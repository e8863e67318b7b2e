"""Tracks and roads: curvature, centre line, closure, the speed along them, and what is refused."""

import csv

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import fresnel

from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.roads import (
    CLASSES,
    Segment,
    SpeedLimits,
    SpeedProfile,
    Track,
    draw_road,
    driven_line,
    load_track,
    random_generator,
    speed_profile,
)
from tests.support.counts import EVIDENCE


def make_track(*segments: tuple[float, float, float], closed: bool = False) -> Track:
    return Track(
        name="test",
        description="a test",
        closed=closed,
        segments=tuple(Segment(length_m=s[0], curvature_1pm=s[1:]) for s in segments),
    )


@pytest.mark.parametrize(
    ("name", "length_m", "gap_m"),
    [("waterford_hills", 2230.9, 0.0055), ("melbourne", 5240.9, 0.0155)],
)
def test_circuits_have_the_stated_length_and_close(
    name: str, length_m: float, gap_m: float
) -> None:
    track = load_track(name, SHIPPED_CONFIGS)
    assert track.length_m == pytest.approx(length_m, abs=0.06)
    gap, turn = track.closure()
    assert gap <= gap_m
    assert turn < 1e-4
    line = track.centre_line(1.0)
    assert line.heading_rad[-1] == pytest.approx(-2 * np.pi, abs=1e-4), "both run clockwise"


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("waterford_hills", "waterford_hills_segments.csv"),
        ("melbourne", "melbourne_raceline_segments.csv"),
    ],
)
def test_segments_are_those_of_the_source(name: str, file: str) -> None:
    with (EVIDENCE / "tracks" / file).open(encoding="utf-8") as lines:
        rows = [
            (float(r["length_m"]), float(r["kappa_start_1pm"]), float(r["kappa_end_1pm"]))
            for r in csv.DictReader(lines)
        ]
    assert rows == [
        (s.length_m, *s.curvature_1pm) for s in load_track(name, SHIPPED_CONFIGS).segments
    ]


def test_clothoid_is_the_fresnel_integral() -> None:
    length, end = 300.0, 0.02
    line = make_track((length, 0.0, end)).centre_line(10.0)
    scale = np.sqrt(np.pi * length / end)
    sine, cosine = fresnel(line.station_m / scale)
    assert np.allclose(line.x_m, scale * cosine, rtol=0, atol=1e-10)
    assert np.allclose(line.y_m, scale * sine, rtol=0, atol=1e-10)


def test_heading_integrates_curvature() -> None:
    track = load_track("waterford_hills", SHIPPED_CONFIGS)
    line = track.centre_line(50.0)
    ends = np.cumsum([segment.length_m for segment in track.segments])
    for a, b, change in zip(
        line.station_m[:-1], line.station_m[1:], np.diff(line.heading_rad), strict=True
    ):
        kinks = ends[(ends > a) & (ends < b)]
        integral = quad(track.curvature, a, b, points=kinks if len(kinks) else None)[0]
        assert integral == pytest.approx(change, abs=1e-12)


ROADS = st.tuples(st.sampled_from(sorted(CLASSES)), st.integers(0, 10**9 - 1))


def turned_rad(track: Track) -> float:
    return float(track.centre_line(1.0).heading_rad[-1])


@given(ROADS)
@settings(max_examples=40, deadline=None)
def test_a_road_is_of_its_class(named: tuple[str, int]) -> None:
    kind, seed = named
    road, limits = draw_road(kind, seed), CLASSES[kind]
    sharpest = max(abs(curvature) for part in road.segments for curvature in part.curvature_1pm)
    assert 1 / limits.radius_m[1] <= sharpest <= 1 / limits.radius_m[0]
    assert road.length_m >= limits.length_m
    assert road.segments[0].curvature_1pm == road.segments[-1].curvature_1pm == (0.0, 0.0)


def test_a_name_is_a_class_and_a_seed() -> None:
    assert load_track("country_17", SHIPPED_CONFIGS).segments == draw_road("country", 17).segments
    assert (
        load_track("country_17", SHIPPED_CONFIGS).segments
        != load_track("country_18", SHIPPED_CONFIGS).segments
    )
    assert load_track("hill_17", SHIPPED_CONFIGS).name == "hill_17"


@given(ROADS, st.floats(1.0, 8.0))
@settings(max_examples=20, deadline=None)
def test_a_cutting_driver_turns_as_far_and_less_sharply(
    named: tuple[str, int], cut_m: float
) -> None:
    road = draw_road(*named)
    line = driven_line(road, cut_m, 0.0, 30.0, random_generator(1))
    assert turned_rad(line) == pytest.approx(turned_rad(road), abs=0.05)
    station = np.linspace(0.0, road.length_m, 5000)
    assert np.abs(line.curvature(station)).max() <= np.abs(road.curvature(station)).max() + 1e-9


def test_a_wandering_driver_stays_near_the_line_and_in_its_direction() -> None:
    road = load_track("straight", SHIPPED_CONFIGS)
    line = driven_line(road, 0.0, 0.2, 30.0, random_generator(1)).centre_line(1.0)
    assert 0.05 < np.std(line.y_m - np.polyval(np.polyfit(line.x_m, line.y_m, 1), line.x_m)) < 2


TRACKS = {
    name: load_track(name, SHIPPED_CONFIGS) for name in ("waterford_hills", "melbourne", "skid_pad")
}
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
