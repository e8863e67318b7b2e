"""Drives in traffic: the same decisions everywhere, and such as a real car can drive."""

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from fleet_slip.errors import ConfigError, RefusedError
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation import traffic
from fleet_slip.simulation.campaign import Batch, DriveSpec, load_campaign
from fleet_slip.simulation.imperfections import Uniform
from fleet_slip.simulation.roads import SLOWEST_MPS, SpeedProfile
from fleet_slip.simulation.simulate import simulate_batch, simulate_logs
from fleet_slip.simulation.traffic import SITES
from tests.support.catalog import SIGNALS
from tests.support.commands import RunCommand, run

SHORT = """
name = "short"
description = "A few seconds in traffic"
base = "traffic"
number_of_days = 1
drives_per_day = 2

[plan.duration_s]
min = 3
max = 4
"""

PROGRAM = """
import sys
from tests.simulation.test_traffic import digests_of
print(digests_of(sys.argv[1:]))
"""


def drives(roads: list[str], duration_s: float = 3.0) -> tuple[DriveSpec, ...]:
    """Return a drive on each road, whose names and seeds do not depend on their order."""
    campaign = load_campaign("traffic", SHIPPED_CONFIGS)
    length = Uniform(min=duration_s, max=duration_s)
    specs = []
    for road in roads:
        tracks = tuple(track for track in campaign.plan.tracks if track.name == road)
        plan = campaign.plan.model_copy(update={"tracks": tracks, "duration_s": length})
        alone = campaign.model_copy(update={"plan": plan})
        specs.append(alone.drives(campaign.first_day)[sorted(SITES).index(road)])
    return tuple(specs)


def batch_of(roads: list[str]) -> Batch:
    return Batch("traffic", load_campaign("traffic", SHIPPED_CONFIGS).first_day, 0, drives(roads))


def digests_of(order: list[str]) -> list[tuple[str, int, str]]:
    """Simulate a drive on each road, in an order; return the roads, rows and their digests."""
    table = simulate_batch(SIGNALS, batch_of(order)).combine_chunks()
    digests = []
    for road in sorted(order):
        rows = table.filter([name.as_py() == road for name in table["track"]]).to_pylist()
        digests.append((road, len(rows), hashlib.sha256(repr(rows).encode()).hexdigest()))
    return digests


def test_a_drive_has_the_same_bytes_in_every_process_and_order() -> None:
    """In another process, which pygame does not greet."""
    roads = sorted(SITES)
    words = [sys.executable, "-c", PROGRAM, *roads[::-1]]
    other_process = run(words, env={**os.environ, "PYTHONHASHSEED": "2024"})
    this_process = digests_of(roads)
    assert other_process.stdout.splitlines() == [str(this_process)], other_process.stderr
    assert [rows for _, rows, _ in this_process] == pytest.approx([300] * len(roads), rel=0.1)


@pytest.fixture(scope="module", params=sorted(SITES))
def spec(request: pytest.FixtureRequest) -> DriveSpec:
    (drive,) = drives([request.param], 30.0)
    return drive


def planned(spec: DriveSpec) -> SpeedProfile:
    assert spec.in_traffic
    return spec.in_traffic


def test_the_plan_keeps_the_driver_s_limits_and_lasts_as_long_as_asked(spec: DriveSpec) -> None:
    profile, limits = planned(spec), spec.limits
    speed = profile.speed_mps * spec.speed_factor
    lateral = np.abs(profile.track.curvature(profile.station_m)) * speed**2
    along = np.diff(speed**2 / 2) / profile.spacing_m
    assert speed.min() >= SLOWEST_MPS
    assert lateral.max() <= 1.1 * limits.lateral_mps2
    assert along.max() <= 1.1 * limits.acceleration_mps2
    assert along.min() >= -1.1 * limits.braking_mps2
    assert profile.time_s(1) / spec.speed_factor == pytest.approx(30.0, abs=0.5)


def test_the_car_follows_it_on_four_tyres(spec: DriveSpec) -> None:
    (log,) = simulate_logs(SIGNALS, [spec], ("lateral_offset_m",))
    assert log.lost_control_s is None
    assert log.rows == pytest.approx(spec.expected_rows, rel=0.02)
    assert np.abs(log.motion["lateral_offset_m"]).max() < 1.0
    assert log.metadata["track"] == spec.track.name


def test_global_changes_of_highway_env_change_no_drive() -> None:
    """Its intersection sets figures of `IDMVehicle` itself."""
    traffic.require_known_traffic("intersection")
    for road in SITES:
        traffic.require_known_traffic(road)


def short(folder: Path, tracks: str = "") -> str:
    file = folder / "short.toml"
    file.write_text(SHORT.replace("[plan.duration_s]", f"[plan]\n{tracks}\n[plan.duration_s]"))
    return str(file)


def test_a_campaign_in_traffic_is_simulated_once(tmp_path: Path, run_command: RunCommand) -> None:
    done = run_command("simulate", short(tmp_path))
    assert done.exit_code == 0, done.stderr
    assert not done.stdout
    assert ": simulated 2 drives, " in done.stderr
    assert len(done.stderr.splitlines()) == 3, done.stderr
    assert "nothing to do" in run_command("simulate", short(tmp_path)).stderr


def test_an_unknown_road_is_named_with_file_and_key(
    tmp_path: Path, run_command: RunCommand
) -> None:
    done = run_command("simulate", short(tmp_path, 'tracks = ["merge", "moon"]'))
    assert done.exit_code == ConfigError.exit_code
    assert "short.toml" in done.stderr
    assert "plan.traffic.tracks.1" in done.stderr
    assert "'moon' is not a road with traffic. Choose from: highway, " in done.stderr


def test_a_road_that_highway_env_lacks_is_named_with_file_and_key(
    tmp_path: Path, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SITES, "merge", SITES["merge"]._replace(environment="merge-v99"))
    done = run_command("simulate", short(tmp_path))
    assert done.exit_code == ConfigError.exit_code
    assert "short.toml" in done.stderr
    assert "plan.traffic.tracks.2" in done.stderr
    assert "has no road 'merge'" in done.stderr


@pytest.mark.parametrize("name", ["acceleration", "steering_control"])
def test_traffic_of_another_kind_is_refused(
    name: str, tmp_path: Path, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    decided: Callable[..., Any] = getattr(IDMVehicle, name)
    monkeypatch.setattr(
        IDMVehicle, name, lambda *arguments, **named: 1.05 * decided(*arguments, **named)
    )
    done = run_command("simulate", short(tmp_path, 'tracks = ["roundabout"]'))
    assert done.exit_code == RefusedError.exit_code
    assert "on its road 'roundabout' differs" in done.stderr
    assert not list((tmp_path / "data").rglob("*.parquet"))
