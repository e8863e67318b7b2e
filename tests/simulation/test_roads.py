"""Roads drawn by class, and the lines of drivers along them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import ConfigError
from fleet_slip.simulation.roads import (
    CLASSES,
    Track,
    draw_road,
    driven_line,
    load_track,
    random_generator,
)

ROADS = st.tuples(st.sampled_from(sorted(CLASSES)), st.integers(0, 10**9 - 1))


def turned_rad(track: Track) -> float:
    return float(track.centre_line(1.0).heading_rad[-1])


@given(ROADS)
@settings(max_examples=40, deadline=None)
def test_a_road_is_of_its_class(named: tuple[str, int]) -> None:
    kind, seed = named
    road, limits = draw_road(kind, seed), CLASSES[kind]
    sharpest = max(abs(one) for part in road.segments for one in part.curvature_1pm)
    assert 1 / limits.radius_m[1] <= sharpest <= 1 / limits.radius_m[0]
    assert road.length_m >= limits.length_m
    assert road.segments[0].curvature_1pm == road.segments[-1].curvature_1pm == (0.0, 0.0)


def test_a_name_is_a_class_and_a_seed() -> None:
    assert load_track("country_17").segments == draw_road("country", 17).segments
    assert load_track("country_17").segments != load_track("country_18").segments
    assert load_track("hill_17").name == "hill_17"


@pytest.mark.parametrize("name", ["country", "country_", "field_3", "country_-1", "country_1e3"])
def test_another_name_is_none(name: str) -> None:
    with pytest.raises(ConfigError):
        load_track(name)


@given(ROADS)
@settings(max_examples=20, deadline=None)
def test_who_neither_cuts_nor_wanders_follows_the_road(named: tuple[str, int]) -> None:
    road = draw_road(*named)
    line = driven_line(road, 0.0, 0.0, 30.0, random_generator(1))
    station = np.linspace(0.0, road.length_m, len(line.segments) + 1)
    np.testing.assert_allclose(line.curvature(station), road.curvature(station), atol=1e-9)


@given(ROADS, st.floats(1.0, 8.0))
@settings(max_examples=20, deadline=None)
def test_who_cuts_turns_as_far_and_less_sharply(named: tuple[str, int], cut_m: float) -> None:
    road = draw_road(*named)
    line = driven_line(road, cut_m, 0.0, 30.0, random_generator(1))
    assert turned_rad(line) == pytest.approx(turned_rad(road), abs=0.05)
    station = np.linspace(0.0, road.length_m, 5000)
    assert np.abs(line.curvature(station)).max() <= np.abs(road.curvature(station)).max() + 1e-9


def test_who_wanders_stays_near_the_line_and_in_its_direction() -> None:
    road = load_track("straight")
    line = driven_line(road, 0.0, 0.2, 30.0, random_generator(1)).centre_line(1.0)
    assert 0.05 < np.std(line.y_m - np.polyval(np.polyfit(line.x_m, line.y_m, 1), line.x_m)) < 2
