"""Drives of every kind, and what a car sees of itself in them over time: see `slow_knowledge`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.columns.blocks.drive_columns import as_counts
from fleet_slip.comparison.evaluation.blind import BlindSet
from fleet_slip.comparison.evaluation.evaluated_drives import EvaluatedDrive, simulate_drives
from fleet_slip.comparison.rivals.inputs import Inputs
from fleet_slip.config import load_config
from fleet_slip.resources import config_file
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.drive_plan import FleetPlan
from fleet_slip.simulation.random_numbers import random_generator
from fleet_slip.simulation.roads import CLASSES, draw_road
from fleet_slip.simulation.scenario import Scenario, load_scenario

EVERY, THIN, BEGIN = 20, 2, 300
"""Ticks between the samples of slow sums, samples between rows, and the first tick."""

ROADS, BEFORE = 3, 3
"""Roads of a fold, and drives of a car that calibrate it."""


class Part(NamedTuple):
    """What is known at each row of a drive, by name, shape (rows,) or (rows, columns)."""

    fold: int
    kind: int
    known: dict[str, FloatArray]


@dataclass(frozen=True)
class Kind:
    """Ranges of a kind of drive."""

    name: str
    adhesion: tuple[float, float] = (0.8, 1.0)
    friction_use: tuple[float, float] = (0.2, 0.6)
    load_kg: tuple[float, float] = (0.0, 0.0)
    place_m: tuple[float, float] = (0.0, 0.0)
    leans: bool = False


KINDS = (
    Kind("ordinary"),
    Kind("load", load_kg=(50, 300), place_m=(-1.2, 0.2)),
    Kind("load far behind", load_kg=(100, 300), place_m=(-1.9, -1.2)),
    Kind("adhesion above .6", adhesion=(0.6, 0.8), friction_use=(0.3, 0.95)),
    Kind(".45 to .6", adhesion=(0.45, 0.6), friction_use=(0.3, 0.95)),
    Kind("below .45", adhesion=(0.2, 0.45), friction_use=(0.3, 0.95)),
    Kind("limit", friction_use=(0.75, 0.95)),
    Kind("banked", leans=True),
)


def cars(fleet: bool, folds: int, drives: int) -> Iterator[tuple[int, list[Scenario]]]:
    """Yield the fold of each car, and its drives: those before, then of every kind."""
    blind, base = load_config(config_file("blind.toml"), BlindSet), load_scenario("nominal")
    campaign = load_campaign("fleet_realistic")
    plan = campaign.plan
    assert isinstance(plan, FleetPlan) and plan.imperfections
    for car in range(folds * drives if fleet else folds):
        own = random_generator(base.seed, "car", str(car))
        vehicle, flaws = base.vehicle, base.imperfections
        is_so: dict[str, object] = {"sensors": base.sensors}
        if fleet:
            vehicle = plan.vehicles[own.integers(len(plan.vehicles))]
            is_so = {
                "tyre_stiffness": blind.tyre_stiffness.draw(own),
                "tyre_radius": plan.tyre_radius.draw(own),
                "sensors": plan.sensor_bias_std.draw(campaign.sensors, own),
            }
            flaws = plan.imperfections.draw(own, own)
        found = []
        for number in range(BEFORE + len(KINDS) * (1 if fleet else drives)):
            turn, which = divmod(max(number - BEFORE, 0), len(KINDS))
            kind, name = KINDS[which], f"slow_{fleet:d}_{car}_{number}"
            of = random_generator(base.seed, "drive", name)
            place = 3000 + car * BEFORE + number  # of the drives before, on roads of their own
            if number >= BEFORE:
                place = car % folds * ROADS + (which + turn + car // folds) % ROADS
            road = tuple(CLASSES)[(number if number < BEFORE else place) % len(CLASSES)]
            adhesion, use = of.uniform(*kind.adhesion), of.uniform(*kind.friction_use)
            surface = plan.imperfections.draw(of, of).road
            leans = {"road": surface} if fleet or kind.leans else {}
            content = is_so | {
                "name": name,
                "vehicle": vehicle,
                "description": kind.name,
                "sprung_mass_kg": vehicle.body.sprung_mass_kg + of.uniform(*kind.load_kg),
                "load_position_m": of.uniform(*kind.place_m),
                "track": blind.drivers.line(draw_road(road, place), road, of),
                "adhesion": adhesion,
                "limits": blind.drivers.limits(road, adhesion, use, of),
                "laps": 1,
                "seed": base.seed,
                "imperfections": flaws.model_copy(update=leans),
            }
            found.append(Scenario.model_validate(content))
        yield car % folds, found


def samples(signals: Mapping[str, FloatArray]) -> SimpleNamespace:
    """Return means over 16 ticks and second differences over .64 s, five a second."""
    fl, fr, rl, rr = (signals[f"wheel_{wheel}_rad_s"] for wheel in ("fl", "fr", "rl", "rr"))
    v = np.maximum(0.31 * (fl + fr + rl + rr) / 4, 2)
    ay, yaw_rate, steer = (
        _mean(signals["ay_mps2"]),
        _mean(signals["yaw_rate_rad_s"]),
        _mean((signals["steer_fl_rad"] + signals["steer_fr_rad"]) / 2),
    )
    curvature = _mean(2 * (rr - rl) / np.maximum(rr + rl, 10) / 1.55)
    yaw = (yaw_rate - _late(yaw_rate, 16)) / 0.16
    moved = np.cumsum(signals["ay_mps2"] / v - signals["yaw_rate_rad_s"]) / 100
    found = {
        "ay": ay, "steer": steer, "curvature": curvature, "ax": _mean(signals["ax_mps2"]),
        "slip": 0.31 * _mean(rl + rr - fl - fr) / 2, "yaw": yaw,
        "ay_then": _late(ay, 8), "steer_then": _late(steer, 8),
        "curvature_then": _late(curvature, 8), "moved_2": _second(moved),
        "curvature_2": _second(_mean(signals["yaw_rate_rad_s"] / v)), "ay_2": _second(ay),
        "yaw_2": _second(yaw),
    }  # fmt: skip
    return SimpleNamespace(**{name: one[BEGIN::EVERY] for name, one in found.items()})


def _mean(x: FloatArray) -> FloatArray:
    total = np.concatenate([[0.0], np.cumsum(x)])
    return np.asarray((total[16:] - total[:-16])[np.maximum(np.arange(len(x)) - 15, 0)] / 16)


def _late(x: FloatArray, ticks: int) -> FloatArray:
    return np.concatenate([np.repeat(x[:1], ticks), x[:-ticks]])


def _second(x: FloatArray) -> FloatArray:
    return x - 2 * _late(x, 64) + _late(x, 128)


def running(y: FloatArray, x: Sequence[FloatArray], floor: Sequence[float],
            weight: FloatArray | float = 1.0) -> FloatArray:  # fmt: skip
    """Return what least squares knows of the slopes at each sample, shape (samples, slopes)."""
    of = np.stack(x, axis=1)
    weighed = of * np.broadcast_to(weight, y.shape)[:, None]
    products = np.cumsum(weighed[:, :, None] * of[:, None, :], axis=0) + np.diag(floor)
    found = np.linalg.solve(products, np.cumsum(weighed * y[:, None], axis=0)[..., None])
    return np.asarray(found[..., 0])


USUAL = np.array([-0.00035, 2.7235, 0.0021, 0.00199, 0.0137, 1.336, -0.00557, 0.00346, 0.0])
"""The sedan's own numbers."""


def relations(s: SimpleNamespace, own: FloatArray) -> dict[str, FloatArray]:
    """Return the slopes that a drive shows beyond the car's own numbers, and what else it tells."""
    steady = (s.ax > -0.5) / (1 + s.ay**2)
    excess = s.steer - own[0] - own[1] * s.curvature
    then = s.steer_then - own[0] - own[1] * s.curvature_then
    moved = s.moved_2 - own[5] * s.curvature_2 - own[6] * s.ay_2 - own[7] * s.yaw_2
    late = running(then - own[3] * _bent(s.ay_then) - own[4] * s.yaw, (s.ay_then, s.yaw), (10, 1))
    places = np.maximum(np.arange(len(s.ay))[:, None] - np.arange(300), 0)
    return {
        "understeer": running(excess - own[2] * _bent(s.ay), (s.ay,), (10,), steady),
        "damping": late,
        "kinematic": running(moved, (s.curvature_2, s.ay_2, s.yaw_2), (3e-4, 20, 1)),
        "peak": np.abs(s.ay)[places].max(axis=1, keepdims=True),
        "slip": running(s.slip - own[8] * s.ax, (s.ax,), (10,)),
    }


def _bent(ay: FloatArray) -> FloatArray:
    return np.asarray(ay * (1 + 0.0018 * np.abs(ay) ** 3))


def calibrate(before: Sequence[SimpleNamespace]) -> FloatArray:
    """Return a car's own numbers: what the same relations tell of dry, empty drives."""
    s = SimpleNamespace(
        **{name: np.concatenate([vars(one)[name] for one in before]) for name in vars(before[0])}
    )
    one, dry = np.ones(len(s.ay)), s.ax > -0.5
    static = running(s.steer, (one, s.curvature, _bent(s.ay)), (1, 1e-3, 1), dry)[-1]
    then = s.steer_then - static[0] - static[1] * s.curvature_then
    return np.concatenate([
        static,
        running(then, (_bent(s.ay_then), s.yaw), (10, 1))[-1],
        running(s.moved_2, (s.curvature_2, s.ay_2, s.yaw_2), (3e-4, 20, 1))[-1],
        running(s.slip, (s.ax,), (10,))[-1],
    ])  # fmt: skip


def simulated(fleet: bool, folds: int, drives: int) -> tuple[list[Part], tuple[str, ...]]:
    """Return what is known at each row of all drives, and the names of the columns."""
    known = features()
    scales = {name: float(input_scales()[name]) for name in known.feature_set("gated").inputs}
    inputs = Inputs(scales, known.rows(()), known.definitions("gated"))
    found = []
    for fold, scenarios in cars(fleet, folds, drives):
        all_drives = simulate_drives(scenarios)
        own = calibrate([samples(drive.signals) for drive in all_drives[:BEFORE]])
        for number, drive in enumerate(all_drives[BEFORE:]):
            if drive.lost_control_s is None:
                at_rows = known_at_rows(drive, inputs, own)
                found.append(Part(fold, number % len(KINDS), at_rows))
    return found, inputs.names


def known_at_rows(drive: EvaluatedDrive, inputs: Inputs, own: FloatArray) -> dict[str, FloatArray]:
    """Return columns, exact angle, what is shown, the car's numbers and the truth of a drive."""
    rows = np.arange(BEGIN, len(drive.time_s), EVERY * THIN)
    counts = as_counts(drive.signals, inputs.plan.signals, drive.facts)
    columns = inputs.values(counts)[rows]
    empty, today = drive.scenario.vehicle.body, drive.scenario.car.body
    shift_m = today.front_axle_m - empty.front_axle_m
    truth = (shift_m, today.mass_kg / empty.mass_kg - 1, drive.scenario.adhesion)
    now = samples(drive.signals)
    shown = relations(now, own) | {"usual": relations(now, USUAL)["understeer"]}
    found: dict[str, FloatArray] = {
        "columns": columns,
        "y": drive.sideslip_rad[rows],
        "truth": np.tile(truth, (len(rows), 1)),
        "own": np.tile(own, (len(rows), 1)),
    } | {name: of[::THIN] for name, of in shown.items()}
    there = drive.evaluated[rows] & np.isfinite(columns).all(axis=1)
    return {name: of[there] for name, of in found.items()}
