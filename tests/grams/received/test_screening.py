"""Messages after something was forgotten: no name is hashed twice, and nothing comes back."""

import json
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.received import screening
from fleet_slip.grams.received.receiving import ReceiveReport
from fleet_slip.maintenance.forget import forget
from fleet_slip.maintenance.retention import Retention, retain
from fleet_slip.runs.log import LOGGER
from fleet_slip.warehouse import audit
from fleet_slip.warehouse.audit import Audit, Forgettable
from fleet_slip.warehouse.cleared_cars import Cleared, ClearedCars
from tests.support.messages import START_S, gram_of, message_of

DAY_S = 86_400

Send = Callable[..., ReceiveReport]


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    return fleet_slip.open(tmp_path / "data")


@pytest.fixture
def cleared(tmp_path: Path) -> ClearedCars:
    return ClearedCars(LocalFolder(tmp_path / "data"))


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


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names that are hashed from now on."""
    audit._digest.cache_clear()
    names: list[str] = []
    slow = audit._digest

    def told(text: str, salt: str) -> str:
        names.append(text)
        return slow(text, salt)

    monkeypatch.setattr(audit, "_digest", told)
    return names


def mentions(folder: Path, name: str) -> list[Path]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return [path for path in files if name.encode() in path.read_bytes()]


def test_only_names_that_nobody_knew_are_hashed(
    fleet: fleet_slip.Fleet, send: Send, hashed: list[str]
) -> None:
    send(0, "VIN0", "VIN1", "VIN2", "VIN3")
    fleet.forget(vehicle="VIN1")
    fleet.forget(drive="VIN2-20240501T100000Z")
    hashed.clear()
    report = send(1, "VIN0", "VIN1", "VIN2", "VIN3", "VIN4")
    assert (report.received, report.forgotten) == (4, 1)
    assert set(hashed) == {
        "vehicle:VIN1",
        "vehicle:VIN2",
        "drive:VIN2-20240502T100000Z",
        "vehicle:VIN4",
    }
    hashed.clear()
    assert send(2, "VIN0", "VIN3", "VIN4").received == 3
    assert hashed == []


def test_a_single_drive_stays_forgotten_and_its_car_goes_on(
    fleet: fleet_slip.Fleet, send: Send, tmp_path: Path
) -> None:
    send(0, "VIN0", "VIN1")
    fleet.forget(drive="VIN1-20240501T100000Z", now=True)
    (tmp_path / "again").write_bytes(message_of(gram_of(1), "VIN1"))
    (report,) = fleet.receive(tmp_path / "again")
    assert (report.received, report.forgotten) == (0, 1)
    assert send(1, "VIN1").received == 1


def test_no_file_names_a_forgotten_car_whoever_was_compared_before(
    fleet: fleet_slip.Fleet, send: Send, tmp_path: Path
) -> None:
    send(0, "ALFA", "BETA", "GAMMA")
    fleet.forget(vehicle="ALFA", now=True)
    send(1, "BETA", "GAMMA", "DELTA")
    assert mentions(tmp_path / "data" / "cleared", "DELTA")
    fleet.forget(vehicle="DELTA", now=True)
    assert mentions(tmp_path / "data", "BETA")
    assert not mentions(tmp_path / "data", "ALFA")
    assert not mentions(tmp_path / "data", "DELTA")
    assert len(list((tmp_path / "data" / "cleared").iterdir())) == 1
    assert send(2, "ALFA", "DELTA").forgotten == 2


def test_an_erasure_that_was_killed_bars_the_car_that_is_still_in_the_list(
    fleet: fleet_slip.Fleet, send: Send, cleared: ClearedCars
) -> None:
    send(0, "VIN0", "VIN1", "VIN2")
    fleet.forget(vehicle="VIN0")
    Audit(fleet.root).begin(Forgettable("vehicle", "VIN1"), 1, [])
    assert cleared.read() == Cleared(frozenset({1}), frozenset({"VIN1", "VIN2"}))
    assert send(1, "VIN1", "VIN2").forgotten == 1
    fleet.forget(vehicle="VIN1")
    assert cleared.read() == Cleared(frozenset({1, 3}), frozenset({"VIN2"}))


def test_erasures_at_the_same_moment_leave_a_list_that_is_cleared_of_all(
    fleet: fleet_slip.Fleet, send: Send, cleared: ClearedCars
) -> None:
    send(0, "VIN0", "VIN1", "VIN2", "VIN3")
    fleet.forget(vehicle="VIN0")
    both = [Forgettable("vehicle", "VIN1"), Forgettable("vehicle", "VIN2")]
    record = Audit(fleet.root)
    for subject in both:
        record.begin(subject, 1, [])
    for subject in reversed(both):
        forget(fleet.warehouse, subject)
    assert cleared.read() == Cleared(record.begun(), frozenset({"VIN3"}))


def test_a_car_is_not_cleared_while_it_is_being_forgotten(
    fleet: fleet_slip.Fleet, send: Send, cleared: ClearedCars, monkeypatch: pytest.MonkeyPatch
) -> None:
    send(0, "VIN0", "VIN1", "VIN2")
    found = []

    def look(*_: Any) -> None:
        found.append((cleared.read(), send(1, "VIN1", "VIN2").forgotten))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("fleet_slip.maintenance.forget.forget_received", look)
        forget(fleet.warehouse, Forgettable("vehicle", "VIN1"))
    assert found == [(Cleared(frozenset({1}), frozenset({"VIN0", "VIN2"})), 1)]


def test_a_job_that_saw_less_of_the_record_clears_nobody(cleared: ClearedCars) -> None:
    cleared.add(Cleared(frozenset({1, 3}), frozenset({"A"})))
    cleared.add(Cleared(frozenset({1}), frozenset({"A", "B", "C"})))
    assert cleared.read() == Cleared(frozenset({1, 3}), frozenset({"A"}))
    cleared.add(Cleared(frozenset({1, 3}), frozenset({"B"})))
    assert cleared.read() == Cleared(frozenset({1, 3}), frozenset({"A", "B"}))


def test_writers_at_the_same_moment_lose_no_removal(
    cleared: ClearedCars, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One looks at the list, another replaces it twice, and the first is late."""
    one = frozenset({1})
    cleared.add(Cleared(one, frozenset({"A", "B"})))
    newest = ClearedCars._newest
    late = newest(cleared)
    cleared.keep(lambda: {"A"})
    cleared.add(Cleared(one, frozenset({"C"})))
    answers = [late]
    monkeypatch.setattr(
        ClearedCars, "_newest", lambda self: answers.pop() if answers else newest(self)
    )
    cleared.add(Cleared(one, frozenset({"D"})))
    assert cleared.read() == Cleared(one, frozenset({"A", "C", "D"}))
    assert len(cleared._numbers()) == 1


def test_a_car_is_allowed_and_forgotten_again(fleet: fleet_slip.Fleet, send: Send) -> None:
    send(0, "VIN0", "VIN1")
    fleet.forget(vehicle="VIN1")
    fleet.allow(vehicle="VIN1")
    assert send(1, "VIN1").received == 1
    assert send(2, "VIN1").received == 1
    fleet.forget(vehicle="VIN1")
    assert send(3, "VIN0", "VIN1").forgotten == 1


def test_entries_that_do_not_say_whose_drive_it_was_bar_it_all_the_same(
    fleet: fleet_slip.Fleet, send: Send, hashed: list[str]
) -> None:
    """Those of earlier versions."""
    send(0, "VIN0")
    forgotten = Forgettable("drive", "VIN1-20240502T100000Z")
    salt = "00" * 16
    content: dict[str, Any] = {"kind": "drive", "salt": salt, "subject": forgotten.digest(salt)}
    documents = Audit(fleet.root)._folder
    documents.append({**content, "event": "begun", "at": "", "drives": 1, "models": []})
    assert send(1, "VIN0", "VIN1").forgotten == 1
    fleet.forget(vehicle="VIN0")
    hashed.clear()
    assert send(2, "VIN2").received == 1
    assert "drive:VIN2-20240503T100000Z" in hashed


@pytest.mark.parametrize("damage", ["", "{}", "[]", '{"entries": [1], "sha256": ""}\nVIN1'])
def test_a_damaged_list_is_made_anew(
    fleet: fleet_slip.Fleet, send: Send, cleared: ClearedCars, tmp_path: Path, damage: str
) -> None:
    send(0, "VIN0", "VIN1")
    fleet.forget(vehicle="VIN1")
    (file,) = (tmp_path / "data" / "cleared").iterdir()
    file.write_text(damage)
    assert cleared.read() is None
    assert send(1, "VIN0", "VIN1").forgotten == 1
    assert cleared.read() == Cleared(frozenset({1}), frozenset({"VIN0"}))


def test_names_leave_the_list_with_the_last_row_of_their_car(
    fleet: fleet_slip.Fleet, send: Send, cleared: ClearedCars
) -> None:
    send(0, "VIN0", "VIN1", "VIN2")
    fleet.forget(vehicle="VIN0")
    send(30, "VIN2")
    today = date(2024, 6, 5)
    retain(fleet.warehouse, Retention(drives_days=20, replaced_files_hours=168), today)
    assert cleared.read() == Cleared(frozenset({1}), frozenset({"VIN2"}))


def test_the_record_says_whose_drive_it_was_by_a_hash(fleet: fleet_slip.Fleet, send: Send) -> None:
    send(0, "VIN0", "VIN1")
    fleet.forget(drive="VIN1-20240501T100000Z")
    record = Audit(fleet.root)
    assert "VIN1" not in json.dumps(record.entries())
    assert record.with_forgotten_drives(["VIN0", "VIN1"]) == {"VIN1"}
    fleet.allow(drive="VIN1-20240501T100000Z")
    assert record.with_forgotten_drives(["VIN0", "VIN1"]) == frozenset()


def test_what_takes_long_is_said_before(
    send: Send, fleet: fleet_slip.Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(screening, "MANY", 1)
    monkeypatch.setattr(LOGGER, "info", lambda text, *given: told.append(text % given))
    send(0, "A", "B")
    assert not [one for one in told if "compared" in one]
    fleet.forget(vehicle="A", now=True)
    send(1, "C", "D", "E")
    assert [one for one in told if "compared" in one] == [
        "3 cars that came for the first time are compared with what was forgotten, once: some 0 s"
    ]
    send(2, "C", "D", "E")
    assert len([one for one in told if "compared" in one]) == 1
