"""Messages of feature sets: changes of the course that cars counted, beside their signals."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.catalogue.course_change import BESIDE
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.received.car_keys import KEYS_VARIABLE
from fleet_slip.grams.received.signatures import sign_days, sign_messages
from fleet_slip.grams.rows.gram_job import update_grams
from fleet_slip.models.ed25519 import generate
from fleet_slip.regression.exact.gram import Gram
from tests.support.logs import land, log_rows
from tests.support.messages import (
    START_S,
    drive_counts,
    gram_of,
    message_of,
    set_message_of,
)

COLUMNS = ("ay", "ay_mean_16", *BESIDE, catalogue().label)
DRIVE = "VIN1-20240501T100000Z"


def changes(seed: int, rows: int = 400, most: int = 2000) -> Gram:
    """Changes of two columns of a drive, and what its course told."""
    counts = np.random.default_rng(seed).integers(-most, most + 1, (rows, len(COLUMNS)))
    counts[:, 3] = counts[:, 3] > 0
    counts[:, 4] = counts[:, 3] * counts[:, 5]
    return Gram.from_counts(COLUMNS, counts)


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    return fleet_slip.open(tmp_path / "data")


def receive(fleet: fleet_slip.Fleet, tmp_path: Path, *messages: bytes) -> Any:
    path = tmp_path / f"m{len(list(tmp_path.iterdir()))}"
    path.write_bytes(b"".join(messages))
    (report,) = fleet.receive(path)
    return report


def stored(fleet: fleet_slip.Fleet) -> list[tuple[Any, ...]]:
    return fleet.sql(
        "SELECT drive_id, feature_set, part, signals, n, course_late FROM grams ORDER BY ALL"
    ).fetchall()


def test_a_message_of_changes_is_a_row_of_its_set(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    gram = changes(1)
    report = receive(fleet, tmp_path, set_message_of(gram, late=-7), message_of(gram_of(1)))
    assert (report.received, report.refused) == (2, {})
    course = (DRIVE, features().identity("course"), None, ",".join(COLUMNS), 400, -7)
    plain = (DRIVE, "signals", None, ",".join(catalogue().gram_signals), 500, None)
    assert stored(fleet) == [course, plain]
    found = fleet.sql("SELECT sums, products FROM grams WHERE n = 400").fetchall()
    assert found == [([*gram.sums], [*gram.products])]
    assert fleet.sql("SELECT drive_id, rows FROM drives").fetchall() == [(DRIVE, 500)]
    again = receive(fleet, tmp_path, set_message_of(gram, late=-7), set_message_of(changes(2)))
    assert (again.duplicates, again.received) == (1, 0)
    assert dict(again.refused) == {"contradicts another message of its drive": 1}
    assert not fleet.verify(full=True).damage


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (set_message_of(changes(1), definition=1), "is of signals that mean something else here"),
        (
            message_of(
                gram_of(1), definition=int.from_bytes(set_message_of(changes(1))[8:16], "little")
            ),
            "is of signals that mean something else here",
        ),
        (set_message_of(changes(1), part=1), "is of signals or parts that there are not"),
        (
            set_message_of(changes(1), mask=2**511 + 31),
            "is of signals or parts that there are not",
        ),
        (set_message_of(changes(1), late=201), "is corrected by a delay that no course has"),
        (
            set_message_of(changes(1), "course", mask=7),
            "has a length that does not fit its signals",
        ),
        (set_message_of(changes(1), lost=1), "lacks rows of its drive"),
        (set_message_of(changes(1), rows=2**22), "has no rows, or more than a drive can have"),
        (
            set_message_of(changes(1, most=9000)),
            "has products that no integer counts can have",
        ),
    ],
)
def test_what_cannot_be_goes_to_the_quarantine(
    fleet: fleet_slip.Fleet, tmp_path: Path, message: bytes, reason: str
) -> None:
    report = receive(fleet, tmp_path, message, set_message_of(changes(3), vehicle="VIN2"))
    assert (report.received, dict(report.refused)) == (1, {reason: 1})


@pytest.mark.parametrize(("sign", "layout"), [(sign_messages, b"\x04\0"), (sign_days, b"\x41\0")])
def test_signatures_of_messages_of_changes_are_checked_again(
    fleet: fleet_slip.Fleet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    sign: Callable[[bytes, bytes], bytes],
    layout: bytes,
) -> None:
    private, public = generate()
    messages = b"".join((set_message_of(changes(1), late=9), message_of(gram_of(1))))
    receive(fleet, tmp_path, set_message_of(changes(2)), message_of(gram_of(2)))
    keys = tmp_path / "keys.csv"
    keys.write_text(f"vehicle_id,public_key\nVIN1,{public.decode().splitlines()[1]}\n")
    monkeypatch.setenv(KEYS_VARIABLE, str(keys))
    assert not receive(fleet, tmp_path, messages, b" ").received, "they are not signed"
    signed = sign(messages, private)
    assert signed[4:6] == layout
    forged = bytearray(signed)
    forged[130] ^= 1
    assert receive(fleet, tmp_path, signed).received == 2
    assert len(stored(fleet)) == 2, "what was unsigned gave way"
    checked = fleet.verify(full=True)
    assert (checked.damage, checked.signatures_checked) == ([], 2)
    assert not receive(fleet, tmp_path, bytes(forged)).received


@pytest.mark.parametrize("name", ["trip-1", DRIVE])
def test_the_log_of_a_drive_takes_the_place_of_all_that_its_car_sent(
    fleet: fleet_slip.Fleet, tmp_path: Path, name: str
) -> None:
    sent = set_message_of(changes(1)), message_of(gram_of(1))
    other = set_message_of(changes(2), vehicle="VIN2", start_s=START_S)
    receive(fleet, tmp_path, *sent, other)
    counts = dict(zip(catalogue().gram_signals, drive_counts(1).T, strict=True))
    land(fleet.warehouse, "trip", log_rows(name, counts, vehicle_id="VIN1"))
    assert update_grams(fleet.warehouse).received_dropped == 2
    assert {row[0] for row in stored(fleet)} == {name, "VIN2-20240501T100000Z"}
    after = receive(fleet, tmp_path, *sent)
    assert dict(after.refused) == {"has a drive whose log is here": 2}


def test_the_rows_of_a_set_stay_where_another_set_is_computed(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    receive(fleet, tmp_path, set_message_of(changes(1)), set_message_of(changes(1), vehicle="VIN2"))
    counts = dict(zip(catalogue().gram_signals, drive_counts(3).T, strict=True))
    land(fleet.warehouse, "trip", log_rows("trip-1", counts, vehicle_id="VIN1"))
    assert update_grams(fleet.warehouse, feature_set="course").received_dropped == 0
    assert sum(row[4] == 400 for row in stored(fleet)) == 2


def test_drives_whose_changes_came_are_not_left_out(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    receive(
        fleet,
        tmp_path,
        *(message_of(gram_of(car), f"VIN{car}") for car in range(6)),
        *(set_message_of(changes(car), vehicle=f"VIN{car}") for car in range(4)),
    )
    selection = fleet.cohort().select(label="course", model="ay,ay_mean_16", intercept=False)
    assert (selection.cohort.left_out, selection.cohort.members.count_received) == (2, 4)


def test_a_car_that_says_that_it_drove_long_weighs_no_more_for_it(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    many = changes(99)
    numbers = [tuple(300 * number for number in some) for some in (many.sums, many.products)]
    liar = Gram(many.signals, 300 * many.n, *numbers)
    receive(
        fleet,
        tmp_path,
        *(set_message_of(changes(car), vehicle=f"VIN{car}") for car in range(40)),
        set_message_of(liar, vehicle="LIAR"),
    )
    selection = fleet.cohort().select(label="course", model="ay,ay_mean_16", intercept=False)
    assert [one.vehicle_id for one in selection.cohort.outweighing] == ["LIAR"]
