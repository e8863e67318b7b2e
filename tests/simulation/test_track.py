"""Tracks: curvature, centre line, closure, and what is refused."""

import csv

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import fresnel

from fleet_slip.simulation.roads import Segment, Track, load_track
from tests.support.evidence import EVIDENCE


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
    track = load_track(name)
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
    assert rows == [(s.length_m, *s.curvature_1pm) for s in load_track(name).segments]


def test_circle_is_a_circle() -> None:
    line = load_track("skid_pad").centre_line(0.7)
    assert np.allclose(np.hypot(line.x_m, line.y_m - 50.0), 50.0, rtol=0, atol=1e-11)
    assert line.y_m.max() > 99.9, "positive curvature bends left"


def test_clothoid_is_the_fresnel_integral() -> None:
    length, end = 300.0, 0.02
    line = make_track((length, 0.0, end)).centre_line(10.0)
    scale = np.sqrt(np.pi * length / end)
    sine, cosine = fresnel(line.station_m / scale)
    assert np.allclose(line.x_m, scale * cosine, rtol=0, atol=1e-10)
    assert np.allclose(line.y_m, scale * sine, rtol=0, atol=1e-10)


def test_heading_integrates_curvature() -> None:
    track = load_track("waterford_hills")
    line = track.centre_line(50.0)
    ends = np.cumsum([segment.length_m for segment in track.segments])
    for a, b, change in zip(
        line.station_m[:-1], line.station_m[1:], np.diff(line.heading_rad), strict=True
    ):
        kinks = ends[(ends > a) & (ends < b)]
        integral = quad(track.curvature, a, b, points=kinks if len(kinks) else None)[0]
        assert integral == pytest.approx(change, abs=1e-12)


def test_grid_of_a_closed_track_leaves_out_its_end() -> None:
    station, spacing = load_track("skid_pad").grid(1.0)
    assert len(station) == 314
    assert station[-1] + spacing == pytest.approx(314.159265)
    station, spacing = load_track("straight").grid(1.0)
    assert (len(station), spacing, station[-1]) == (1001, 1.0, 1000.0)
