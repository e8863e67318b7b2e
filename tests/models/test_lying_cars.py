"""Cars that send rows with a wrong label: none of them, nor a few, decide what is true."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import RefusedError
from fleet_slip.grams.cohorts import outweighing
from fleet_slip.models.estimates.counts_model import counts_model
from fleet_slip.models.manifest import Manifest
from fleet_slip.regression.exact.figures import error_sums
from fleet_slip.regression.exact.gram import Gram, packed_position
from fleet_slip.selection.select_models import RequestedSelection
from tests.support.cars import counts, drive
from tests.support.messages import START_S, message_of

CARS = 60
DAY_S = 86_400
INPUTS = "ay,yaw_rate,steering_wheel,wheel_fl,wheel_fr"


@pytest.fixture(scope="module")
def grams() -> list[Gram]:
    """The Gram of a drive of half a minute of each car."""
    names = catalogue().gram_signals
    found = []
    for car in range(CARS):
        told = counts(drive(np.random.default_rng(car), gentleness=2.0))
        matrix = np.column_stack([told[name].astype(np.int64) for name in names])
        found.append(Gram.from_counts(names, matrix))
    return found


@pytest.fixture
def fleet(tmp_path: Path, grams: Sequence[Gram]) -> fleet_slip.Fleet:
    """A fleet whose champion was made of the honest drives of a day."""
    fleet = fleet_slip.open(tmp_path / "data")
    receive(fleet, tmp_path / "honest", honest(grams, START_S))
    fleet.publish("beta", select(fleet))
    receive(fleet, tmp_path / "next", honest(grams, START_S + DAY_S))
    return fleet


def honest(grams: Sequence[Gram], start_s: int) -> list[bytes]:
    return [message_of(gram, f"VIN{car}", start_s) for car, gram in enumerate(grams)]


def receive(fleet: fleet_slip.Fleet, path: Path, messages: Sequence[bytes]) -> None:
    path.write_bytes(b"".join(messages))
    (report,) = fleet.receive(path)
    assert report.received == len(messages), report


def select(fleet: fleet_slip.Fleet) -> RequestedSelection:
    return fleet.cohort().select(model=INPUTS)


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
    scaled = (tuple(times * number for number in some) for some in (sums, products))
    return Gram(gram.signals, times * gram.n, *scaled)


def error_deg(manifest: Manifest, grams: Sequence[Gram]) -> float:
    """RMSE of a version on the honest drives."""
    model = counts_model(manifest)
    total = sum(grams[1:], grams[0]).restrict((*model.signals, model.label))
    return error_sums(model, total).figures(catalogue()[model.label].exact_scale).rmse_deg


def forged(grams: Sequence[Gram], how: str) -> list[bytes]:
    """What liars send on the second day: drives of a day, which is as long as one may be."""
    start_s = START_S + DAY_S
    day = 2880
    if how == "gain":
        return [message_of(lie(grams[0], gain=3, times=day), "LIAR", start_s)]
    if how == "offset":
        return [message_of(lie(grams[0], offset=200, times=day), "LIAR", start_s)]
    if how == "many small":
        some = [lie(gram, gain=3) for gram in grams]
        return [message_of(one, "LIAR", start_s + 31 * i) for i, one in enumerate(some * 4)]
    several = [lie(gram, offset=200, times=day) for gram in grams[:5]]
    return [message_of(one, f"LIAR{i}", start_s) for i, one in enumerate(several)]


LIES = ("gain", "offset", "many small", "several cars")


@pytest.mark.parametrize("how", LIES)
def test_in_a_first_version_no_car_outweighs_the_others(
    tmp_path: Path, grams: Sequence[Gram], how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    receive(fleet, tmp_path / "honest", honest(grams, START_S))
    before = error_deg(fleet.publish("before", select(fleet)).version.manifest, grams)
    receive(fleet, tmp_path / "forged", forged(grams, how))
    selection = select(fleet)
    after = error_deg(fleet.publish("after", selection).version.manifest, grams)
    assert after < 1.6 * before
    assert {one.vehicle_id[:4] for one in selection.cohort.outweighing} == {"LIAR"}
    rows = fleet.sql(
        f"SELECT sum(n) FROM grams WHERE {selection.as_dict()['models'][0]['gram_rows']}"
    )
    assert rows.fetchall() == [(selection.cohort.rows,)]
    monkeypatch.setattr(outweighing, "MOST_CARS", 10**6)
    unbounded = fleet.publish("unbounded", select(fleet), force=True).version.manifest
    assert error_deg(unbounded, grams) > 10 * before


@pytest.mark.parametrize("how", LIES)
def test_the_gate_asks_groups_of_cars_not_rows(
    fleet: fleet_slip.Fleet,
    tmp_path: Path,
    grams: Sequence[Gram],
    how: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    receive(fleet, tmp_path / "forged", forged(grams, how))
    monkeypatch.setattr(outweighing, "MOST_CARS", 10**6)
    with pytest.raises(RefusedError, match="it is worse than the champion"):
        fleet.publish("beta", select(fleet))


def test_a_fleet_that_does_not_lie_replaces_its_champion(fleet: fleet_slip.Fleet) -> None:
    selection = select(fleet)
    assert selection.cohort.outweighing == ()
    assert fleet.publish("beta", selection).version.version == 2


def test_of_few_cars_none_is_too_many(tmp_path: Path, grams: Sequence[Gram]) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    messages = [message_of(gram, "MOST", START_S + 60 * i) for i, gram in enumerate(grams)]
    receive(fleet, tmp_path / "m", [*messages, *honest(grams[:3], START_S)])
    assert select(fleet).cohort.outweighing == ()
