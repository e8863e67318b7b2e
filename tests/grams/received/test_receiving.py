"""`receive`: Gram rows of cars that send no log live beside those of logs."""

import json
import shutil
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.cli.app import app
from fleet_slip.errors import InputError, QuestionError
from fleet_slip.grams.received import found_messages
from fleet_slip.grams.received.found_messages import read_messages
from fleet_slip.maintenance.forget import forget
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.warehouse.audit import Forgettable
from tests.support.commands import done_on, run_on
from tests.support.messages import START_S, gram_of, message_of, parse_messages


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    return fleet_slip.open(tmp_path / "data")


def write(path: Path, *messages: bytes) -> Path:
    path.write_bytes(b"".join(messages))
    return path


def drives(count: int, cars: int = 3) -> list[bytes]:
    return [
        message_of(gram_of(i), f"VIN{i % cars}", START_S + 86_400 * (i // cars))
        for i in range(count)
    ]


def stored(fleet: fleet_slip.Fleet) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = (
        fleet.sql("FROM grams ORDER BY drive_id, signals").to_arrow_table().to_pylist()
    )
    return rows


def reasons(fleet: fleet_slip.Fleet) -> list[tuple[Any, ...]]:
    return fleet.sql(
        'SELECT "row", drive_id, vehicle_id, reason FROM quarantine ORDER BY ALL'
    ).fetchall()


def test_a_message_becomes_a_gram_row_and_a_drive(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    gram = gram_of(1)
    (report,) = fleet.receive(write(tmp_path / "m", message_of(gram)))
    assert (report.messages, report.received, report.rows) == (1, 1, 500)
    (row,) = stored(fleet)
    assert (row["drive_id"], row["vehicle_id"]) == ("VIN1-20240501T100000Z", "VIN1")
    assert (row["source"], str(row["day"]), row["part"]) == ("received", "2024-05-01", None)
    found = Gram(
        tuple(row["signals"].split(",")), row["n"], tuple(row["sums"]), tuple(row["products"])
    )
    assert found == gram
    drive = fleet.sql("SELECT drive_id, vehicle_id, day, rows FROM drives").fetchall()
    assert drive == [("VIN1-20240501T100000Z", "VIN1", row["day"], 500)]


def test_models_are_those_of_all_rows(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    fleet.receive(write(tmp_path / "m", *drives(12)))
    selection = fleet.cohort().select()
    publication = fleet.publish("cars", selection, force=True)
    trained = publication.version.manifest.trained_on
    assert (trained.drives, trained.drives_without_log, trained.vehicles) == (12, 12, 3)
    assert trained.rows == 12 * 500


def test_a_file_and_a_message_land_once(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    messages = drives(4)
    file = write(tmp_path / "m", *messages[:3], messages[0])
    (report,) = fleet.receive(file)
    assert (report.received, report.duplicates) == (3, 1)
    (again,) = fleet.receive(file)
    assert (again.new, again.received) == (False, 0)
    (other,) = fleet.receive(write(tmp_path / "n", *messages))
    assert (other.received, other.duplicates) == (1, 3)
    assert len(stored(fleet)) == 4
    assert reasons(fleet) == []


def test_another_message_of_a_drive_is_refused(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    fleet.receive(write(tmp_path / "m", message_of(gram_of(1))))
    fleet.receive(write(tmp_path / "n", message_of(gram_of(2)), message_of(gram_of(3), "VIN2")))
    assert [row["vehicle_id"] for row in stored(fleet)] == ["VIN1", "VIN2"]
    assert reasons(fleet) == [
        (1, "VIN1-20240501T100000Z", "VIN1", "the message contradicts another message of its drive")
    ]


def broken(gram: Gram, **fields: Any) -> Gram:
    return Gram(
        gram.signals, **{"n": gram.n, "sums": gram.sums, "products": gram.products, **fields}
    )


def scaled(gram: Gram, times: int) -> Gram:
    """The Gram of the rows of a drive, each so many times."""
    numbers = ([times * number for number in some] for some in (gram.sums, gram.products))
    return Gram(gram.signals, times * gram.n, *map(tuple, numbers))


GRAM = gram_of(5)
FIRST, SECOND, *REST = GRAM.products
SUM = message_of(broken(GRAM, sums=(10**9, *GRAM.sums[1:])))
ODD = message_of(broken(GRAM, products=(FIRST + 1, SECOND, *REST)))
INDEFINITE = message_of(broken(GRAM, products=(FIRST, FIRST * 5, *REST)))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (message_of(GRAM)[:-1], "is cut off"),
        (message_of(GRAM)[:40], "is cut off"),
        (message_of(GRAM)[:-1] + b"\x00", "has a wrong checksum"),
        (b"nonsense", "does not begin as a message does"),
        (message_of(GRAM, layout=5), "has another layout"),
        (message_of(GRAM, layout=2), "has a length that does not fit its signals"),
        (message_of(GRAM, size=60), "has a length that does not fit its signals"),
        (message_of(GRAM, size=3), "has a length that does not fit its signals"),
        (message_of(GRAM, mask=2**11 - 2), "has a length that does not fit its signals"),
        (message_of(GRAM, mask=2**12 - 2), "is of signals or parts that there are not"),
        (message_of(GRAM, place=1), "is of signals or parts that there are not"),
        (message_of(GRAM, definition=1), "is of signals that mean something else here"),
        (message_of(GRAM, ""), "has no name of a car"),
        (message_of(GRAM, "a\nb"), "has no name of a car"),
        (message_of(GRAM, "a\0b"), "has no name of a car"),
        (message_of(GRAM, start_s=0), "begins before 2000, or ends in the future"),
        (message_of(GRAM, start_s=2**64 - 1), "begins before 2000, or ends in the future"),
        (message_of(GRAM, start_s=4_070_908_800), "begins before 2000, or ends in the future"),
        (message_of(scaled(GRAM, 20_000)), "is of a drive longer than a day"),
        (message_of(GRAM, lost=1), "lacks rows of its drive"),
        (message_of(GRAM, rows=0), "has no rows, or more than a drive can have"),
        (SUM, "has sums outside the ranges of its signals"),
        (ODD, "has products that no integer counts can have"),
        (INDEFINITE, "has a matrix that is not positive semidefinite"),
    ],
)  # fmt: skip
def test_what_cannot_be_goes_to_the_quarantine(
    fleet: fleet_slip.Fleet, tmp_path: Path, message: bytes, reason: str
) -> None:
    good = message_of(gram_of(9), "GOOD")
    (report,) = fleet.receive(write(tmp_path / "m", good, message))
    assert report.refused == {reason: 1}
    assert [(row[0], row[3]) for row in reasons(fleet)] == [(2, f"the message {reason}")]
    assert [row["vehicle_id"] for row in stored(fleet)] == ["GOOD"]


def test_a_drive_may_last_a_day_and_end_a_day_ahead_of_our_clock(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    day = scaled(gram_of(5, 8640), 1000)
    monkeypatch.setattr(time, "time", lambda: START_S + 0.5)
    messages = [message_of(day, "IN", START_S), message_of(day, "LATE", START_S + 1)]
    (report,) = fleet.receive(write(tmp_path / "m", *messages))
    assert report.refused == {"begins before 2000, or ends in the future": 1}
    assert [(row["vehicle_id"], row["n"]) for row in stored(fleet)] == [("IN", 8_640_000)]


def test_messages_are_read_as_one_by_one() -> None:
    sets = [gram_of(i).restrict(gram_of(i).signals[: 3 + i % 4 // 2]) for i in range(12)]
    content = b"".join(message_of(gram, f"CAR{i}") for i, gram in enumerate([*sets, *sets]))
    found = read_messages(content)
    assert not found.refused
    read = [message for _, some in found.runs for message in some]
    expected = parse_messages(content)
    assert len(found.runs) == 12
    assert [first for first, _ in found.runs] == list(range(1, 25, 2))
    for one, other in zip(read, expected, strict=True):
        assert one.tobytes() == other.content
        assert one["vehicle"] == other.vehicle
        assert one["numbers"].tobytes() == other.numbers
        for name in ("definition", "place", "parts", "start_s", "mask", "rows", "lost"):
            assert one[name] == getattr(other, name)


def test_files_land_together_and_each_has_its_report(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    fleet.receive(write(tmp_path / "first", message_of(gram_of(0), "FIRST")))
    version = fleet.warehouse.grams.snapshot().version
    some, half = gram_of(1), gram_of(2).restrict(gram_of(2).signals[:4])
    files = [
        write(tmp_path / "1", message_of(some, "A"), message_of(half, "B"), b"FSGR"),
        write(tmp_path / "2", message_of(half, "B"), message_of(some, "B")),
        write(tmp_path / "3", message_of(half, "A"), message_of(gram_of(3), "A"), b"x"),
    ]
    again = write(tmp_path / "4", files[0].read_bytes())
    reports = fleet.receive([*files, again])
    assert [(r.new, r.messages, r.received, r.duplicates) for r in reports] == [
        (True, 3, 2, 0),
        (True, 2, 1, 1),
        (True, 3, 1, 0),
        (False, 0, 0, 0),
    ]
    assert [dict(r.refused) for r in reports[:3]] == [
        {"is cut off": 1},
        {},
        {"contradicts another message of its drive": 1, "does not begin as a message does": 1},
    ]
    assert fleet.warehouse.grams.snapshot().version == (version or 0) + 1
    assert [row[:2] for row in reasons(fleet)] == [(2, "A-20240501T100000Z"), (3, None), (3, None)]
    assert len({row["file"] for row in stored(fleet)}) == 4


def test_files_beside_those_that_cannot_be_read_land(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    folder = tmp_path / "messages"
    folder.mkdir()
    for name in ("2", "4"):
        (folder / name).write_bytes(b"")
    write(folder / "1", message_of(GRAM))
    write(folder / "3", message_of(GRAM, "VIN3"))
    with pytest.raises(InputError, match=r"2: is empty\. Nor can 1 other file be read: .*4: is e"):
        fleet.receive(folder)
    assert len(stored(fleet)) == 2
    write(folder / "5", message_of(GRAM, "VIN5"))
    done = run_on(tmp_path / "data", "receive", folder, "--json")
    assert done.exit_code == InputError.exit_code
    assert [one["received"] for one in done.json] == [0, 0, 1]


@pytest.mark.parametrize("piece", [b"FSGR", b"xFSGR", b"FSGR\x01\0\x3c\0" + bytes(52)])
def test_what_is_no_file_of_messages_is_not_read_to_its_end(piece: bytes) -> None:
    found = read_messages(message_of(GRAM) + piece * 100_000)
    assert [len(messages) for _, messages in found.runs] == [1]
    assert len(found.refused) == 1001
    assert found.refused[-1] == (
        1002,
        "and all that follows is not read, after 1,000 places that are no message",
    )


def test_a_file_has_so_many_messages_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(found_messages, "MOST_MESSAGES", 5)
    found = read_messages(b"".join(drives(9)))
    assert [len(some) for _, some in found.runs] == [5]
    assert [number for number, _ in found.refused] == [6]


def test_messages_of_two_lengths_by_turns_are_read_at_once(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    sets = [GRAM, GRAM.restrict(GRAM.signals[:3])]
    many = [message_of(sets[i % 2], f"VIN{i}") for i in range(40)]
    (report,) = fleet.receive(write(tmp_path / "m", *many, b"x", many[0]))
    assert (report.messages, report.received, report.duplicates) == (42, 40, 1)
    assert [row[0] for row in reasons(fleet)] == [41]


def test_names_of_drives_say_when_they_began(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    moments = [946_684_800, 951_782_399, 951_868_800, 1_735_689_599]
    fleet.receive(write(tmp_path / "m", *(message_of(GRAM, "V", at) for at in moments)))
    told = [datetime.fromtimestamp(at, UTC) for at in moments]
    found = fleet.sql("SELECT drive_id, day FROM drives ORDER BY day").fetchall()
    assert found == [(f"V-{at:%Y%m%dT%H%M%SZ}", at.date()) for at in told]


def test_after_damage_reading_goes_on_at_the_next_message() -> None:
    content = b"".join(drives(4))
    size = len(content) // 4
    for at in (*range(0, size, 7), size - 1):
        damaged = bytearray(content)
        damaged[size + at] ^= 0x10
        found = read_messages(bytes(damaged))
        assert b"".join(messages.tobytes() for _, messages in found.runs) == (
            content[:size] + content[2 * size :]
        )
        assert [number for number, _ in found.refused] == list(range(2, found.count - 1))


def test_no_bytes_end_in_an_error(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    content = b"".join(drives(3))
    for case in range(40):
        damaged = bytearray(content[: int(random.integers(1, len(content)))])
        for at in random.integers(0, len(damaged), 5):
            damaged[at] = int(random.integers(256))
        found = read_messages(bytes(damaged))
        read = sum(len(messages) for _, messages in found.runs)
        assert found.count == read + len(found.refused), case


def test_a_car_is_forgotten_and_does_not_come_back(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    messages = drives(6)
    fleet.receive(write(tmp_path / "m", *messages))
    report = fleet.forget(vehicle="VIN1", now=True)
    assert (report.drives, report.rows) == (2, 1000)
    assert {row["vehicle_id"] for row in stored(fleet)} == {"VIN0", "VIN2"}
    (again,) = fleet.receive(write(tmp_path / "n", *messages, b"x"))
    assert (again.received, again.duplicates, again.forgotten) == (0, 4, 2)
    for file in (tmp_path / "data" / "grams").rglob("*.parquet"):
        assert b"VIN1" not in file.read_bytes()


def test_old_drives_are_forgotten(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    fleet.receive(write(tmp_path / "m", *drives(6)))
    forget(fleet.warehouse, Forgettable("before", "2024-05-02"))
    assert {str(row["day"]) for row in stored(fleet)} == {"2024-05-02"}


def test_the_other_jobs_know_them(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    messages = [message_of(gram_of(i, 6000), f"VIN{i}") for i in range(6)]
    fleet.receive(write(tmp_path / "m", *messages))
    assert not fleet.gram().changed
    assert fleet.verify(full=True).findings == []
    assert fleet.quality().drives == 6
    fleet.compact()
    assert fleet.status().tables["grams"].rows == 6
    with pytest.raises(QuestionError):
        fleet.forget(vehicle="VIN7")
    assert len(stored(fleet)) == 6


def test_rows_live_beside_those_of_logs(
    smoke_root: Path, fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    shutil.copytree(smoke_root, tmp_path / "data")
    before, rows = stored(fleet), fleet.score("smoke").rows
    (report,) = fleet.receive(write(tmp_path / "m", *drives(2)))
    assert report.received == 2
    assert fleet.score("smoke").rows == rows
    assert len(stored(fleet)) == len(before) + 2
    assert not fleet.gram().changed
    assert fleet.verify().findings == []


def test_what_cannot_be_read_is_said(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    for path, said in (("absent", "no file"), ("empty", "is empty"), ("folder", "no folder")):
        with pytest.raises(InputError, match=said):
            fleet.receive(tmp_path / path)


def test_the_command_says_what_became_of_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "messages" / "day"
    folder.mkdir(parents=True)
    write(folder / "1", *drives(3))
    write(folder / "2", *drives(2), b"x")
    words = ["--root", str(tmp_path / "data"), "receive", str(tmp_path / "messages")]
    for more in ([], ["--json"]):
        with pytest.raises(SystemExit) as ended:
            app([*words, *more])
        assert ended.value.code == 0
        if not more:
            said = capsys.readouterr().err
            assert "3 messages, 3 new Gram rows of 1,500 rows" in said
            assert "2 duplicates; in quarantine: 1 does not begin as a message does" in said
    assert [one["new"] for one in json.loads(capsys.readouterr().out)] == [False, False]


def test_a_file_without_a_message_that_can_be_used_is_an_error(tmp_path: Path) -> None:
    folder = tmp_path / "messages"
    folder.mkdir()
    write(folder / "1", *drives(2))
    write(folder / "2", b"no message at all")
    done = run_on(tmp_path / "data", "receive", folder, "--json")
    assert done.exit_code == InputError.exit_code
    assert [(one["received"], one["refused"]) for one in done.json] == [
        (2, {}),
        (0, {"does not begin as a message does": 1}),
    ]
    assert f"{folder / '2'}: no message in it can be used" in done.stderr
    assert done_on(tmp_path / "data", "receive", folder), "once landed, it is nothing to do"
