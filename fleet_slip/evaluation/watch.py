"""A drive as a page that plays: one file without a server."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from markupsafe import Markup

from fleet_slip.arrays import FloatArray
from fleet_slip.base import pluralize
from fleet_slip.catalog.signals import MEASURED, SAMPLE_TIME_S
from fleet_slip.errors import ConfigError, DataError, QuestionError, UsageError
from fleet_slip.evaluation.evaluated_drives import simulate_drives
from fleet_slip.models.registry import ModelVersion
from fleet_slip.pages.page import fill_in
from fleet_slip.quality.drive_signals import RADIUS_M
from fleet_slip.resources import Configs
from fleet_slip.simulation.roads import load_track
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.simulation.simulate import MOTION
from fleet_slip.storage.local import LocalFolder
from fleet_slip.views import open_views
from fleet_slip.warehouse.warehouse import Warehouse

FRAMES_PER_S = 25
SPACING_M = 3.0
SMOOTHED_TICKS = 51
WHEELS = tuple(f"wheel_{wheel}_rad_s" for wheel in ("fl", "fr", "rl", "rr"))
FACTS = ("vehicle_model", "mass_kg")


@dataclass(frozen=True)
class DriveFrames:
    """A drive at 25 frames a second; arrays have shape (frames,).

    Attributes
    ----------
    model
        The version that estimates, NAME@VERSION.
    x_m, y_m, heading_rad
        Position and heading of the car on the ground.
    sideslip_deg
        The true angle, or that of a reference sensor; NaN where the drive has none.
    estimate_deg
        The estimate; NaN where the model lacks a signal.
    wheel_rad_s
        Speeds of fl, fr, rl, rr, shape (4, frames); NaN where they were not logged.
    steer_rad
        Mean angle of the front wheels.
    track
        x and y of the track's centre line; empty without a track.
    reference
        Word for the angle on the page: true, or reference for a measured one.
    """

    title: str
    model: str
    time_s: FloatArray
    speed_mps: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    heading_rad: FloatArray
    sideslip_deg: FloatArray
    estimate_deg: FloatArray
    wheel_rad_s: FloatArray
    steer_rad: FloatArray
    track: tuple[FloatArray, FloatArray]
    reference: str = "true"

    def part(self, from_s: float, until_s: float | None) -> "DriveFrames":
        """Return the frames of a part of the drive. Raises `UsageError` if it has none."""
        mask = self.time_s >= from_s
        if until_s is not None:
            mask &= self.time_s <= until_s
        if mask.sum() < 2:
            raise UsageError(
                f"the drive lasts from {self.time_s[0]:.1f} to {self.time_s[-1]:.1f} s; choose a "
                "part of it."
            )
        series: dict[str, Any] = {
            name: v[..., mask] for name, v in vars(self).items() if isinstance(v, np.ndarray)
        }
        return replace(self, **series)


def drive_frames(warehouse: Warehouse, name: str, version: ModelVersion) -> DriveFrames:
    """Return the frames of a scenario, or of a drive by its id, its name, or its file's name.

    Raises `QuestionError` if there is no such drive, or several.
    """
    if name.endswith(".toml") or name in warehouse.configs.names("scenarios"):
        return scenario_frames(name, version)
    names = [signal.column for signal in warehouse.catalog.signals.signals.values()]
    query = f"SELECT time_s, source, track, vehicle_model, mass_kg, {', '.join(names)} FROM log"
    with open_views(warehouse, f"{query}, drives") as database:
        named = "SELECT drive_id FROM drives WHERE $name IN (drive_id, drive_name, source_file)"
        ids = [drive for (drive,) in database.sql(named, params={"name": name}).fetchall()]
        drive_id = name if name in ids or len(ids) != 1 else ids[0]
        if len(ids) > 1 and name not in ids:
            raise QuestionError(
                f"{name!r} names {pluralize(len(ids), 'drive')}. Choose one: {', '.join(ids[:9])}"
            )
        statement = f"{query} WHERE drive_id = $drive ORDER BY time_s"
        rows = database.sql(statement, params={"drive": drive_id}).to_arrow_table()
    if not rows.num_rows:
        raise QuestionError(
            f"{name!r} is neither a drive nor a scenario. See: "
            'fleet-slip sql "SELECT drive_id, drive_name, source_file FROM drives"'
        )
    columns = {name: rows[name].to_numpy().astype(np.float64) for name in (*names, "time_s")}
    time_s = columns.pop("time_s")
    facts = {name: rows[name][0].as_py() for name in (*FACTS, "track")}
    facts["drive_id"] = drive_id
    frames = frames_of(drive_id, columns, facts, time_s, version)
    return replace(
        frames, reference="reference" if rows["source"][0].as_py() == MEASURED else "true"
    )


def frames_of(
    title: str,
    columns: Mapping[str, FloatArray],
    facts: Mapping[str, Any],
    time_s: FloatArray,
    version: ModelVersion,
) -> DriveFrames:
    """Return the frames of a drive. Raises `DataError` without a velocity.

    The columns are those of the catalog, shape (ticks,), NaN where null; `facts` are the model
    and mass of the car, its `drive_id`, and its `track` if it has one.
    """
    frames = np.flatnonzero(
        np.diff(np.floor((time_s - time_s[0]) * FRAMES_PER_S + 1e-6), prepend=-1)
    )
    # The drive as the view `log` has it; NaN is null there.
    arrays = {name: pa.array(values, from_pandas=True) for name, values in columns.items()}
    constants = {name: pa.array([value] * len(time_s)) for name, value in facts.items()}
    estimate = version.predict(pa.table({**constants, "time_s": time_s, **arrays}))
    vx, vy = _velocity(columns)
    x, y, heading, track = _places(version.catalog.configs, columns, facts, time_s, vx, vy)
    return DriveFrames(
        title=title,
        model=version.reference,
        time_s=time_s[frames],
        speed_mps=np.hypot(vx, vy)[frames],
        x_m=x[frames],
        y_m=y[frames],
        heading_rad=heading[frames],
        sideslip_deg=np.degrees(columns["sideslip_rad"])[frames],
        estimate_deg=np.degrees(np.asarray(estimate, dtype=np.float64))[frames],
        wheel_rad_s=np.stack([columns[name] for name in WHEELS])[:, frames],
        steer_rad=((columns["steer_fl_rad"] + columns["steer_fr_rad"]) / 2)[frames],
        track=track,
    )


def _velocity(columns: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return vx and vy, from a speed and the reference angle if need be. Raises `DataError`."""
    wheels = np.ma.masked_invalid([columns[name] for name in WHEELS]).mean(axis=0) * RADIUS_M
    speeds = [columns["vx_mps"], np.ma.filled(wheels, np.nan)]
    if "vehicle_speed_mps" in columns:
        speeds.append(columns["vehicle_speed_mps"])
    vx = next((speed for speed in speeds if np.isfinite(speed).any()), None)
    if vx is None:
        raise DataError("the drive has neither a speed nor wheel speeds: nothing can be shown.")
    vx, vy = np.nan_to_num(vx), columns["vy_mps"]
    if not np.isfinite(vy).any():
        vy = vx * np.tan(np.nan_to_num(columns["sideslip_rad"]))
    return vx, np.nan_to_num(vy)


def _smooth(values: FloatArray) -> FloatArray:
    """Average over half a second around each tick, over less at the ends."""
    window = np.ones(SMOOTHED_TICKS)
    weights = np.convolve(np.ones(len(values)), window, "same")
    smoothed: FloatArray = values[0] + np.convolve(values - values[0], window, "same") / weights
    return smoothed


def _places(
    configs: Configs,
    columns: Mapping[str, FloatArray],
    facts: Mapping[str, Any],
    time_s: FloatArray,
    vx: FloatArray,
    vy: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, tuple[FloatArray, FloatArray]]:
    """Return x, y and heading of the car, and the centre line of its track if it has one."""
    station, offset = columns["station_m"], columns["lateral_offset_m"]
    track, name = None, facts.get("track")
    with suppress(ConfigError):  # a road of highway-env, or a file that is not here
        track = load_track(name, configs) if name else None
    if track and np.isfinite(station).all():
        line = track.centre_line(SPACING_M)
        # The log has stations in steps of 0.25 m, which the car would jump.
        smooth_m, offset = _smooth(np.unwrap(station, period=track.length_m)), _smooth(offset)
        at_m = smooth_m % track.length_m if track.closed else smooth_m
        x, y, along = line.at(at_m)
        x, y = x - offset * np.sin(along), y + offset * np.cos(along)
        course = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
        return x, y, course - np.arctan2(vy, np.maximum(vx, 0.5)), (line.x_m, line.y_m)
    step = np.diff(time_s, prepend=time_s[0] - float(SAMPLE_TIME_S))
    heading = np.cumsum(np.nan_to_num(columns["yaw_rate_rad_s"]) * step)
    x = np.cumsum((vx * np.cos(heading) - vy * np.sin(heading)) * step)
    y = np.cumsum((vx * np.sin(heading) + vy * np.cos(heading)) * step)
    return x, y, heading, (np.empty(0), np.empty(0))


def write_page(frames: DriveFrames, file: Path) -> None:
    """Write the page as a whole, or not at all. Raises `StorageError`."""
    LocalFolder(file.parent).put(file.name, render_watch(frames).encode("utf-8"))


def render_watch(frames: DriveFrames) -> str:
    """Return the page."""
    wheels = frames.wheel_rad_s
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = wheels.mean(axis=0)
        excess = 100 * np.where(mean > 1, wheels / mean - 1, np.nan)
    series = {
        "t": (frames.time_s, 2),
        "speed": (frames.speed_mps, 2),
        "x": (frames.x_m, 2),
        "y": (frames.y_m, 2),
        "heading": (frames.heading_rad, 4),
        "beta": (frames.sideslip_deg, 3),
        "estimate": (frames.estimate_deg, 3),
        "steer": (frames.steer_rad, 4),
    }
    data: dict[str, Any] = {name: _listed(*values) for name, values in series.items()}
    data["wheels"] = [_listed(wheel, 2) for wheel in excess]
    data["track"] = [_listed(axis, 1) for axis in frames.track]
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    # Within a script element only this could end it.
    return fill_in(
        "watch.html.j2",
        frames=frames,
        data=Markup(text.replace("<", "\\u003c")),  # noqa: S704
    )


def _listed(values: FloatArray, digits: int) -> list[float | None]:
    """Return numbers for JSON, None for what is not finite."""
    return [round(value, digits) if np.isfinite(value) else None for value in values.tolist()]


def scenario_frames(name: str, version: ModelVersion) -> DriveFrames:
    """Return the frames of a test drive, which is simulated. Raises `ConfigError`."""
    scenario = load_scenario(name, version.catalog.configs)
    (drive,) = simulate_drives(version.catalog.signals, [scenario])
    motion = {column: getattr(drive, column) for column in ("sideslip_rad", *MOTION)}
    facts = {**drive.vehicle_attributes, "track": scenario.way.name, "drive_id": scenario.drive_id}
    title = f"{scenario.name}: {scenario.description}"
    return frames_of(title, {**drive.columns, **motion}, facts, drive.time_s, version)
