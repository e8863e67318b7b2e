"""A few cars that send rows with a wrong label do not replace the champion."""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.errors import RefusedError
from fleet_slip.models.summary import Selection
from fleet_slip.regression.gram import Gram, packed_position
from tests.support.cars import counts, drive, gram_of
from tests.support.counted_rows import START_S, row_of, write_counted

Rows = list[dict[str, Any]]
CARS = 60
DAY_S = 86_400
INPUTS = "ay,yaw_rate,steering_wheel,wheel_fl,wheel_fr"


@pytest.fixture(scope="module")
def grams() -> list[Gram]:
    """The Gram of a drive of half a minute of each car."""
    return drive_grams(range(CARS))


def drive_grams(seeds: Iterable[int]) -> list[Gram]:
    drives = (drive(np.random.default_rng(seed), gentleness=2.0) for seed in seeds)
    return [gram_of(counts(signals)) for signals in drives]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, grams: Sequence[Gram]) -> Path:
    """A fleet whose champion was made of the honest drives of a day. Copy it."""
    folder = tmp_path_factory.mktemp("honest")
    fleet = fleet_slip.open(folder / "data")
    receive(fleet, folder / "honest", honest(grams, START_S))
    fleet.models.publish("beta", select(fleet))
    next_day = drive_grams(range(CARS, 2 * CARS))
    receive(fleet, folder / "next", honest(next_day, START_S + DAY_S))
    return folder / "data"


@pytest.fixture
def fleet(tmp_path: Path, root: Path) -> fleet_slip.Fleet:
    return fleet_slip.open(shutil.copytree(root, tmp_path / "data"))


def honest(grams: Sequence[Gram], start_s: int) -> Rows:
    return [row_of(gram, f"VIN{car}", start_s) for car, gram in enumerate(grams)]


def receive(fleet: fleet_slip.Fleet, path: Path, rows: Rows) -> None:
    assert fleet.import_onboard_grams(write_counted(path, rows)).gram_rows == len(rows)


def select(fleet: fleet_slip.Fleet) -> Selection:
    return fleet.cohort(include_faulty=True).select(model=INPUTS)


def lie(gram: Gram, gain: int = 1, offset: int = 0, times: int = 1) -> Gram:
    """The Gram of rows whose label has a gain and an offset in counts, each row so many times."""
    y = len(gram.signals) - 1
    sums, products = list(gram.sums), list(gram.products)
    for i in range(y):
        at = packed_position(y, i)
        products[at] = gain * products[at] + offset * sums[i]
    at = packed_position(y, y)
    products[at] = gain**2 * products[at] + 2 * gain * offset * sums[y] + offset**2 * gram.n
    sums[y] = gain * sums[y] + offset * gram.n
    return Gram(gram.signals, gram.n, tuple(sums), tuple(products)).scaled(times)


def forged(grams: Sequence[Gram], how: str) -> Rows:
    """Return the drives of the liars on the second day: a whole day, the most that is accepted."""
    start_s = START_S + DAY_S
    day = 2880
    if how == "gain":
        return [row_of(lie(grams[0], gain=3, times=day), "LIAR", start_s)]
    several = [lie(gram, offset=200, times=day) for gram in grams[:5]]
    return [row_of(drive_gram, f"LIAR{i}", start_s) for i, drive_gram in enumerate(several)]


@pytest.mark.parametrize("how", ["gain", "several cars"])
def test_cars_with_a_wrong_label_are_unusual_whatever_their_rows(
    fleet: fleet_slip.Fleet, tmp_path: Path, grams: Sequence[Gram], how: str
) -> None:
    receive(fleet, tmp_path / "forged", forged(grams, how))
    with pytest.raises(RefusedError, match=r"not published: (beta@1 had|it is worse than)"):
        fleet.models.publish("beta", select(fleet))


def test_a_fleet_that_does_not_lie_replaces_its_champion(fleet: fleet_slip.Fleet) -> None:
    assert fleet.models.publish("beta", select(fleet)).version.version == 2
