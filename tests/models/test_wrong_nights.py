"""Nights on which all cars log what is wrong and well-formed: no way to a champion trains on them.

By command, by night and in Python the same drives train a new name, and none of the three moves an
old one away from the truth.
"""

import math
import shutil
from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import RefusedError
from fleet_slip.grams.update import update_grams
from fleet_slip.models.manifest import Manifest
from fleet_slip.regression.folds import error_sums
from fleet_slip.regression.gram import Gram
from tests.support.cars import Signals, counts, drive, gram_of
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.commands import RunCommand
from tests.support.logs import DAY, land, log_rows
from tests.support.once import made_once

CARS, DAYS = 12, 2
NIGHT = DAY + timedelta(days=DAYS)
WORST = 1.01
"""RMSE on honest drives, over that of the model of the honest days."""

Change = Callable[[Signals], object]


def times(name: str, factor: float) -> Change:
    return lambda signals: signals.update({name: factor * signals[name]})


def plus(name: str, offset: float) -> Change:
    return lambda signals: signals.update({name: signals[name] + offset})


def late(name: str, ticks: int) -> Change:
    return lambda signals: signals.update(
        {name: np.r_[np.full(ticks, signals[name][0]), signals[name][:-ticks]]}
    )


def stuck(name: str) -> Change:
    return lambda signals: signals.update({name: np.full_like(signals[name], signals[name][0])})


def drifting(name: str, by: float) -> Change:
    return lambda signals: signals.update(
        {name: signals[name] + np.linspace(0, by, len(signals[name]))}
    )


def exchanged(pairs: Mapping[str, str]) -> Change:
    return lambda signals: signals.update({a: signals[b] for a, b in pairs.items()})


LEFT_RIGHT = {
    f"wheel_{end}{side}": f"wheel_{end}{'lr'[side == 'l']}" for end in "fr" for side in "lr"
}
WRONG: Mapping[str, Change] = {
    "label in degrees taken for rad": times("sideslip", 57.3),
    "label in rad taken for degrees": times("sideslip", 1 / 57.3),
    "label reversed": times("sideslip", -1),
    "label doubled": times("sideslip", 2),
    "label times 1.5": times("sideslip", 1.5),
    "label 1 deg off": plus("sideslip", math.radians(1)),
    "label 1 s late": late("sideslip", 100),
    "label 0.3 s late": late("sideslip", 30),
    "label stuck": stuck("sideslip"),
    "label drifting": drifting("sideslip", math.radians(2)),
    "ay stuck": stuck("ay"),
    "ay reversed": times("ay", -1),
    "ay in g": times("ay", 1 / 9.81),
    "ax and ay exchanged": exchanged({"ax": "ay", "ay": "ax"}),
    "yaw rate stuck": stuck("yaw_rate"),
    "yaw rate without its sign": lambda signals_: signals_.update(
        yaw_rate=np.abs(signals_["yaw_rate"])
    ),
    "wheels left and right exchanged": exchanged(LEFT_RIGHT),
}
USUAL = ("label in rad taken for degrees",)
"""Kinds that every run tests in all ways; long runs test the others, each in one way."""
WAYS = ("command", "night", "python")


def land_day(fleet: Fleet, number: int, rng: np.random.Generator, change: Change | None) -> None:
    day = DAY + timedelta(days=number)
    drives = []
    for car in range(CARS):
        signals = drive(rng, gentleness=2)
        if change:
            change(signals)
        largest = {name: 32767 * float(SIGNALS[name].scale) for name in signals}
        clipped = {
            name: np.clip(values, -largest[name], largest[name]) for name, values in signals.items()
        }
        drives.append(
            log_rows(
                f"{day}-{car:02d}", counts(clipped), day, vehicle_id=f"car-{car}", source="measured"
            )
        )
    land(fleet.warehouse, str(day), *drives, day=day)


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root with two honest days and the champion `old` of them."""

    def make(folder: Path) -> None:
        fleet, rng = fleet_slip.open(folder), np.random.default_rng(1)
        for number in range(DAYS):
            land_day(fleet, number, rng, None)
        update_grams(fleet.warehouse)
        chosen = fleet.cohort().select(models="table1")
        for name in ("old", *WAYS):
            fleet.models.publish(name, chosen)

    return made_once(tmp_path_factory, "wrong_nights", make)


@pytest.fixture(scope="module")
def truth() -> Gram:
    """The Gram of honest drives that train nothing."""
    rng = np.random.default_rng(9)
    grams = [gram_of(counts(drive(rng, gentleness=2))) for _ in range(CARS)]
    return sum(grams[1:], grams[0])


def error_deg(manifest: Manifest, truth: Gram) -> float:
    model = manifest.counts_model(CATALOG)
    sums = error_sums(model, truth.restrict((*model.signals, model.label)))
    return sums.figures(SIGNALS[model.label].exact_scale).rmse_deg


@pytest.mark.parametrize(
    "kind",
    [item if item in USUAL else pytest.param(item, marks=pytest.mark.long) for item in WRONG],
)
def test_every_way_to_a_champion_leaves_a_wrong_night_out(
    honest: Path, truth: Gram, tmp_path: Path, run_command: RunCommand, kind: str
) -> None:
    shutil.copytree(honest, tmp_path / "data")
    (landing := tmp_path / "landing").mkdir()
    fleet = fleet_slip.open(tmp_path / "data")
    right = error_deg(fleet.models.get("old").manifest, truth)
    land_day(fleet, DAYS, np.random.default_rng(2), WRONG[kind])
    update_grams(fleet.warehouse)

    ways = WAYS if kind in USUAL else WAYS[list(WRONG).index(kind) % 3 :][:1]
    for prefix in ("new_", ""):
        code = 7
        if "command" in ways:
            code = run_command("publish", f"{prefix}command", "--models", "table1").exit_code
            assert code in (0, 7)
        if "python" in ways:
            try:
                fleet.models.publish(f"{prefix}python", fleet.cohort().select(models="table1"))
            except RefusedError:
                assert code == 7
        if "night" in ways:
            name = f"{prefix}night"
            fleet.nightly(landing, "race_car_250lm", name, models="table1", night=NIGHT)
        manifests = [fleet.models.get(f"{prefix}{way}").manifest for way in ways]
        assert len({item.trained_on.cohort for item in manifests}) == 1
        assert max(error_deg(item, truth) for item in manifests) < WORST * right
