"""A drive as a page that plays."""

import json
import math
import random
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.errors import ConfigError, QuestionError, UsageError
from fleet_slip.evaluation import watch
from fleet_slip.evaluation.watch import DriveFrames, drive_frames, render_watch
from fleet_slip.resources import Configs
from tests.support.measured import OWN_MAPPING, csv_text, own_columns

DRIVE = "smoke-2024-05-01-0000"


@pytest.fixture(scope="module")
def frames(smoke_root: Path) -> DriveFrames:
    fleet = fleet_slip.open(smoke_root)
    return drive_frames(fleet.warehouse, DRIVE, fleet.models.get("smoke"))


def data_of(page: str) -> Any:
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert match
    return json.loads(match[1])


def test_frames_are_those_of_the_log(frames: DriveFrames, smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    log = fleet.sql(
        f"SELECT time_s, sideslip_rad FROM log WHERE drive_id = '{DRIVE}' ORDER BY time_s"
    ).pl()
    assert np.diff(frames.time_s) == pytest.approx(0.04)
    assert len(frames.time_s) == math.ceil(len(log) / 4)
    true = np.degrees(log["sideslip_rad"].to_numpy())[::4]
    assert frames.sideslip_deg == pytest.approx(true, abs=1e-12)
    assert np.nanstd(frames.estimate_deg - frames.sideslip_deg) < 0.2


def test_the_car_moves_as_fast_as_it_drives_and_where_it_goes(frames: DriveFrames) -> None:
    vx, vy = np.gradient(frames.x_m, frames.time_s), np.gradient(frames.y_m, frames.time_s)
    inner = slice(15, -15)  # at the ends of a drive places are smoothed from one side
    assert np.hypot(vx, vy)[inner] == pytest.approx(frames.speed_mps[inner], abs=1.0)
    course = np.arctan2(vy, vx) - frames.heading_rad
    wrapped = np.degrees(np.angle(np.exp(1j * course)))
    off = abs(wrapped - frames.sideslip_deg)[inner]
    assert np.percentile(off, 95) < 1.0
    assert off.max() < 3.0


def test_a_drive_on_a_track_whose_file_is_gone_is_drawn_by_its_motion(
    smoke_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load_track(name: str, _: Configs) -> None:
        raise ConfigError(f"nothing is called {name!r}")

    monkeypatch.setattr(watch, "load_track", load_track)
    fleet = fleet_slip.open(smoke_root)
    drawn = drive_frames(fleet.warehouse, DRIVE, fleet.models.get("smoke"))
    assert not drawn.track[0].size
    assert np.hypot(np.diff(drawn.x_m), np.diff(drawn.y_m)).max() < 3


def test_the_page_contains_the_drive_and_makes_no_request(frames: DriveFrames) -> None:
    page = render_watch(frames)
    data = data_of(page)
    assert len(data["t"]) == len(data["beta"]) == len(data["wheels"][0]) == len(frames.time_s)
    assert "default-src 'none'" in page
    assert not re.findall(r'(?:src|href)="(?!data:)', page)


def test_hostile_names_and_missing_signals_do_not_break_the_page(frames: DriveFrames) -> None:
    nothing = np.full(len(frames.time_s), np.nan)
    hostile = replace(
        frames,
        title="</script><script>alert(1)</script>",
        estimate_deg=nothing,
        wheel_rad_s=np.stack([nothing] * 4),
    )
    page = render_watch(hostile)
    assert "<script>alert" not in page
    assert set(data_of(page)["estimate"]) == {None}


def test_part_cuts_all_series(frames: DriveFrames) -> None:
    part = frames.part(5.0, 6.0)
    assert (part.time_s[0], part.time_s[-1]) == (pytest.approx(5.0), pytest.approx(6.0))
    assert part.wheel_rad_s.shape == (4, len(part.time_s))
    assert len(part.track[0]) == len(frames.track[0])
    with pytest.raises(UsageError, match="the drive lasts from"):
        frames.part(1e6, None)


def test_other_suffixes_and_unknown_drives_are_refused(
    root_to_fail_in: Path, tmp_path: Path
) -> None:
    fleet = fleet_slip.open(root_to_fail_in)
    with pytest.raises(UsageError, match="shown as a page"):
        fleet.evaluation.watch(DRIVE, "smoke", tmp_path / "film.mp4")
    with pytest.raises(QuestionError, match="neither a drive nor a scenario"):
        fleet.evaluation.watch("nobody's", "smoke", tmp_path / "page.html")


def test_a_measured_drive_is_found_by_its_file_and_has_a_reference(
    smoke_copy: Path, tmp_path: Path
) -> None:
    for name, cars in (("monday", "a"), ("tuesday", "bc")):
        seeds = [random.Random(car) for car in cars]  # noqa: S311
        logs = [own_columns(seed) | {"car": [c] * 500} for seed, c in zip(seeds, cars, strict=True)]
        columns = {key: [value for log in logs for value in log[key]] for key in logs[0]}
        text = csv_text(columns | {"v": [12.0] * len(columns["t"])})
        (tmp_path / f"{name}.csv").write_text(text)
    mapping = tmp_path / "own.toml"
    mapping.write_text(OWN_MAPPING + 'vehicle_speed = { column = "v", unit = "m/s" }\n')
    fleet = fleet_slip.open(smoke_copy)
    fleet.ingest([tmp_path / "monday.csv", tmp_path / "tuesday.csv"], str(mapping))
    page = fleet.evaluation.watch("monday.csv", "smoke", tmp_path / "page.html").read_text()
    assert ">reference <" in page.replace("</span>", ">")
    assert "true" not in page.partition("<script>")[0].partition("<h2>")[2]
    with pytest.raises(QuestionError, match="names 2 drives"):
        drive_frames(fleet.warehouse, "tuesday.csv", fleet.models.get("smoke"))


def test_a_scenario_is_simulated_and_shown(smoke_root: Path, tmp_path: Path) -> None:
    """Its drive has the signals of the catalog that estimators read, and no other speed."""
    scenario = tmp_path / "brief.toml"
    scenario.write_text('name = "brief"\ndescription = "x"\nbase = "nominal"\nlaps = 0.1\n')
    page = fleet_slip.open(smoke_root).evaluation.watch(
        str(scenario), "smoke", tmp_path / "page.html"
    )
    data = data_of(page.read_text())
    assert "brief: x" in page.read_text()
    assert len(data["t"]) == len(data["beta"]) > 100
    assert len(data["track"][0]) > 100
