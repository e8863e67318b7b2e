"""Messages after something was forgotten: nothing comes back."""

from collections.abc import Callable
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.grams.received.receiving import ReceiveReport
from tests.support.messages import START_S, gram_of, message_of

DAY_S = 86_400

Send = Callable[..., ReceiveReport]


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    return fleet_slip.open(tmp_path / "data")


@pytest.fixture
def send(fleet: fleet_slip.Fleet, tmp_path: Path) -> Send:
    """Send a message of each of some cars on a day; return the report."""

    def sent(day: int, *cars: str) -> ReceiveReport:
        file = tmp_path / f"day {day}"
        grams = [gram_of(10 * day + at) for at in range(len(cars))]
        each = zip(cars, grams, strict=True)
        file.write_bytes(b"".join(message_of(g, car, START_S + DAY_S * day) for car, g in each))
        (report,) = fleet.receive(file)
        return report

    return sent


def test_a_single_drive_stays_forgotten_and_its_car_goes_on(
    fleet: fleet_slip.Fleet, send: Send, tmp_path: Path
) -> None:
    send(0, "VIN0", "VIN1")
    fleet.forget(drive="VIN1-20240501T100000Z", now=True)
    (tmp_path / "again").write_bytes(message_of(gram_of(1), "VIN1"))
    (report,) = fleet.receive(tmp_path / "again")
    assert (report.received, report.forgotten) == (0, 1)
    assert send(1, "VIN1").received == 1


def test_a_car_is_allowed_and_forgotten_again(fleet: fleet_slip.Fleet, send: Send) -> None:
    send(0, "VIN0", "VIN1")
    fleet.forget(vehicle="VIN1")
    fleet.allow(vehicle="VIN1")
    assert send(1, "VIN1").received == 1
    assert send(2, "VIN1").received == 1
    fleet.forget(vehicle="VIN1")
    assert send(3, "VIN0", "VIN1").forgotten == 1
