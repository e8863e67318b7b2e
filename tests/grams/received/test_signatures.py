"""Messages signed by the keys of cars: who may send, and what a revoked key leaves out."""

import base64
import contextlib
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.app import app
from fleet_slip.delta import Change
from fleet_slip.errors import AlarmError, ConfigError, DataError, InputError
from fleet_slip.grams.received.car_keys import KEYS_VARIABLE
from fleet_slip.grams.received.signatures import sign_messages
from fleet_slip.models.ed25519 import generate
from fleet_slip.regression.exact.gram import Gram
from tests.support.messages import START_S, drive_counts, gram_of, message_of

HEADER = "vehicle_id,public_key,valid_from,valid_until,revoked_since"
DAY_S = 86_400


@pytest.fixture(scope="module")
def keys() -> dict[str, tuple[bytes, str]]:
    """Of some names, a private key, and the public one as lists have it."""
    made = {name: generate() for name in ("VIN0", "VIN1", "VIN2", "thief")}
    return {name: (own, known.decode().split("\n")[1]) for name, (own, known) in made.items()}


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    return fleet_slip.open(tmp_path / "data")


def list_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *lines: str) -> None:
    path = tmp_path / f"keys{len(list(tmp_path.iterdir()))}.csv"
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    monkeypatch.setenv(KEYS_VARIABLE, str(path))


def receive(fleet: fleet_slip.Fleet, tmp_path: Path, content: bytes) -> Any:
    path = tmp_path / f"m{len(list(tmp_path.iterdir()))}"
    path.write_bytes(content)
    (report,) = fleet.receive(path)
    return report


def message(car: int, day: int = 0) -> bytes:
    return message_of(gram_of(10 * car + day), f"VIN{car}", START_S + DAY_S * day)


def test_the_signature_is_over_what_the_page_says(keys: dict[str, tuple[bytes, str]]) -> None:
    from cryptography.hazmat.primitives.serialization import load_der_public_key  # noqa: PLC0415

    private, public = keys["VIN1"]
    signed = sign_messages(message(1), private)
    assert len(signed) == 740
    assert signed[4:8] == b"\x02\x00" + (740).to_bytes(2, "little")
    assert signed[8:-68] == message(1)[8:-4]
    key: Any = load_der_public_key(base64.b64decode(public))
    key.verify(signed[-68:-4], b"fleet-slip gram message\n" + signed[:-68])


def test_messages_of_the_key_of_the_car_land_and_no_others(
    fleet: fleet_slip.Fleet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: dict[str, tuple[bytes, str]],
) -> None:
    known = [f"{name},{keys[name][1]},2024-05-01,2024-05-03," for name in ("VIN0", "VIN1")]
    list_keys(tmp_path, monkeypatch, *known, f"VIN2,{keys['VIN2'][1]},,,2024-05-02")
    changed = bytearray(sign_messages(message(1, 1), keys["VIN1"][0]))
    good = sign_messages(message(1), keys["VIN1"][0])
    wrong = [
        message(0),
        sign_messages(message(0), keys["thief"][0]),
        sign_messages(message(0), keys["VIN1"][0]),
        sign_messages(message(0, 3), keys["VIN0"][0]),
        sign_messages(message(2), keys["VIN2"][0]),
        sign_messages(message(3), keys["thief"][0]),
    ]
    report = receive(fleet, tmp_path, good + b"".join(wrong) + bytes(changed[:-1]) + b"?")
    assert report.received == 1
    assert dict(report.refused) == {
        "is not signed": 1,
        "is not signed by the key of its car": 2,
        "is of a car that had no key on that day": 2,
        "is signed by a key that was revoked": 1,
        "has a wrong checksum": 1,
    }
    assert fleet.sql("SELECT vehicle_id FROM drives").fetchall() == [("VIN1",)]


def test_a_signed_message_is_the_unsigned_one_again(
    fleet: fleet_slip.Fleet, tmp_path: Path, keys: dict[str, tuple[bytes, str]]
) -> None:
    assert receive(fleet, tmp_path, message(1) + message(2)).received == 2
    report = receive(fleet, tmp_path, sign_messages(message(1) + message(2), keys["VIN1"][0]))
    assert (report.received, report.duplicates) == (0, 2)


def test_a_signed_message_takes_the_place_of_an_unsigned_one(
    fleet: fleet_slip.Fleet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: dict[str, tuple[bytes, str]],
) -> None:
    forged, true, same = message_of(gram_of(7), "VIN1"), message(1), message(2)
    assert receive(fleet, tmp_path, forged + same + message(3)).received == 3
    signed = [sign_messages(one, keys[f"VIN{car}"][0]) for car, one in ((1, true), (2, same))]
    assert receive(fleet, tmp_path, b"".join(signed)).received == 0, "without keys nothing is sure"
    list_keys(tmp_path, monkeypatch, *(f"{name},{keys[name][1]},,," for name in ("VIN1", "VIN2")))
    report = receive(fleet, tmp_path, b"".join([*signed, signed[0]]))
    assert (report.received, report.duplicates, report.refused) == (1, 2, {})
    found = fleet.sql("SELECT vehicle_id, sums FROM grams ORDER BY ALL").fetchall()
    assert found == [(f"VIN{car}", list(gram_of(10 * car).sums)) for car in (1, 2, 3)]
    other = sign_messages(forged, keys["VIN1"][0])
    assert dict(receive(fleet, tmp_path, other).refused) == {
        "contradicts another message of its drive": 1
    }
    assert fleet.verify(full=True).damage == []


def test_what_a_revoked_key_signed_since_a_day_is_left_out_and_named(
    fleet: fleet_slip.Fleet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: dict[str, tuple[bytes, str]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = [f"{name},{keys[name][1]},,," for name in ("VIN0", "VIN1", "VIN2")]
    list_keys(tmp_path, monkeypatch, *lines)
    signed = [
        sign_messages(message(car, day), keys[f"VIN{car}"][0])
        for car in range(3)
        for day in range(6)
    ]
    assert receive(fleet, tmp_path, b"".join(signed)).received == 18
    assert fleet.cohort().select(model="ax,ay").as_dict()["drives_revoked"] == {}
    list_keys(tmp_path, monkeypatch, *lines[:2], f"{lines[2][:-1]},2024-05-02")
    selection = fleet.cohort().select(model="ax,ay")
    told = selection.as_dict()
    assert (told["drives"], told["drives_revoked"]) == (13, {"VIN2": 5})
    trained = fleet.publish("cars", selection, force=True).version.manifest.trained_on
    assert (trained.drives, trained.drives_without_log) == (13, 13)
    loaded = fleet.cohort().select(nested="ax,ay,yaw_rate", rank="backward")
    assert (loaded.cohort.drive_count, dict(loaded.cohort.revoked)) == (13, {"VIN2": 5})
    with contextlib.suppress(SystemExit):
        app(["--root", str(tmp_path / "data"), "select", "--model", "ax,ay"])
    said_by_cli = " ".join(capsys.readouterr().err.split())
    assert "5 drives of VIN2 left out: a key of it was revoked" in said_by_cli
    assert fleet.quality().revoked == {"VIN2": 5}
    chart = fleet.monitor("cars", since=date(2024, 5, 5))
    assert (sum(day.drives for day in chart.days), chart.drives_revoked) == (13, {"VIN2": 5})
    for words in (["quality"], ["monitor", "cars", "--since", "2024-05-05"]):
        with contextlib.suppress(SystemExit, AlarmError):
            app(["--root", str(tmp_path / "data"), *words])
        said_by_cli = " ".join(capsys.readouterr().err.split())
        assert "5 drives of VIN2 left out: a key of it was revoked" in said_by_cli
    with pytest.raises(DataError, match=r"all 5 drives of .* was revoked"):
        fleet.quality("vehicle_id = 'VIN2' AND day > '2024-05-01'")


@pytest.fixture
def signed_fleet(
    fleet: fleet_slip.Fleet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: dict[str, tuple[bytes, str]],
) -> fleet_slip.Fleet:
    """A root with two signed rows, one of all signals and one of three, and one unsigned row."""
    receive(fleet, tmp_path, message(0))
    list_keys(tmp_path, monkeypatch, *(f"{name},{keys[name][1]},,," for name in ("VIN1", "VIN2")))
    few = Gram.from_counts(catalogue().gram_signals[:3], drive_counts(5)[:, :3].astype(np.int64))
    content = sign_messages(message(1), keys["VIN1"][0])
    content += sign_messages(message_of(few, "VIN2", place=1, parts=2), keys["VIN2"][0])
    assert receive(fleet, tmp_path, content).received == 2
    return fleet


def remarks(fleet: fleet_slip.Fleet) -> list[str]:
    return sorted(finding.problem for finding in fleet.verify(full=True).findings)


def rewrite_rows(fleet: fleet_slip.Fleet, change: Callable[[dict[str, Any]], None]) -> None:
    snapshot = fleet.warehouse.grams.snapshot()
    rows = [row for file in snapshot.files for row in snapshot.table.read(file.path).to_pylist()]
    for row in rows:
        change(row)
    add = [
        snapshot.table.write_file("received-0", pa.Table.from_pylist(rows, snapshot.table.schema))
    ]
    snapshot.commit(Change(add=add, remove=list(snapshot.files), note={"job": "test"}))


def test_signatures_are_kept_and_checked_again(
    signed_fleet: fleet_slip.Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    unsigned = "1 message landed without a signature"
    report = signed_fleet.verify()
    assert (report.signatures, report.signatures_checked, report.damage) == (2, 2, [])
    assert remarks(signed_fleet) == [unsigned]
    signed_fleet.forget(vehicle="VIN0", now=True)  # which writes the file again
    assert remarks(signed_fleet) == []
    assert signed_fleet.verify().signatures_checked == 2
    monkeypatch.delenv(KEYS_VARIABLE)
    report = signed_fleet.verify(full=True)
    assert (report.signatures, report.signatures_checked, report.damage) == (2, 0, [])
    (told,) = remarks(signed_fleet)
    assert told == f"2 signatures of messages not checked: ${KEYS_VARIABLE} names no list of keys"


def test_a_row_that_was_changed_is_damage_though_it_is_plausible(
    signed_fleet: fleet_slip.Fleet,
) -> None:
    def change(row: dict[str, Any]) -> None:
        if row["vehicle_id"] == "VIN1":
            row["sums"][0] += 2

    rewrite_rows(signed_fleet, change)
    (damage,) = signed_fleet.verify().damage
    assert "VIN1-20240501T100000Z is not signed by the key of its car" in damage.problem


def test_what_no_key_is_known_of_or_was_revoked_is_told_apart(
    signed_fleet: fleet_slip.Fleet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: dict[str, tuple[bytes, str]],
) -> None:
    list_keys(tmp_path, monkeypatch, f"VIN1,{keys['VIN1'][1]},,,2024-01-01")
    report = signed_fleet.verify(full=True)
    assert (report.signatures_checked, report.damage) == (1, [])
    keyless = "1 signature of messages not checked: the list of keys has no key"
    assert sum(one.startswith(keyless) for one in remarks(signed_fleet)) == 1
    list_keys(tmp_path, monkeypatch, f"VIN1,{keys['VIN2'][1]},,,")
    assert len(signed_fleet.verify(full=True).damage) == 1


@pytest.mark.parametrize("content", [b"", b"short", bytes(80)])
def test_a_signature_of_another_row_is_damage(
    signed_fleet: fleet_slip.Fleet, content: bytes
) -> None:
    def change(row: dict[str, Any]) -> None:
        row["signed"] = content if row.get("signed") else None

    rewrite_rows(signed_fleet, change)
    assert len(signed_fleet.verify(full=True).damage) == 2


def test_rows_without_a_signature_take_no_byte_more(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    receive(fleet, tmp_path, message(1))
    (file,) = fleet.warehouse.grams.snapshot().files
    assert "signed" not in fleet.warehouse.grams.read(file.path).column_names


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (
            "VIN1,{key},2024-05-01,2024-05-09,\nVIN1,{key},2024-05-09,,",
            "has two keys on 2024-05-09",
        ),
        ("VIN1,c29tZQ==,,,", "is not an Ed25519 public key"),
        ("V'1,{key},,,", "vehicle_id"),
        ("VIN1,{key},yesterday,,", "must be a date"),
        ("VIN1,{key},,,,more", "unknown key"),
        ("VIN1", "public_key: is missing"),
    ],
)
def test_a_wrong_list_of_keys_is_refused(
    fleet: fleet_slip.Fleet,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: dict[str, tuple[bytes, str]],
    line: str,
    problem: str,
) -> None:
    list_keys(tmp_path, monkeypatch, line.format(key=keys["VIN1"][1]))
    with pytest.raises(ConfigError, match=problem):
        receive(fleet, tmp_path, message(1))


@pytest.mark.parametrize("text", ["", "bad,header\n", "vehicle_id;public_key\nVIN1;x\n"])
def test_a_list_without_its_columns_is_no_list_of_no_keys(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    receive(fleet, tmp_path, message(1))
    (tmp_path / "keys.csv").write_text(text)
    monkeypatch.setenv(KEYS_VARIABLE, str(tmp_path / "keys.csv"))
    for asked in (fleet.quality, fleet.verify):
        with pytest.raises(ConfigError, match="has no column"):
            asked()


def test_a_wrong_list_is_told_though_all_has_landed(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    receive(fleet, tmp_path, message(1))
    monkeypatch.setenv(KEYS_VARIABLE, "no/such/file")
    with pytest.raises(ConfigError, match="cannot be read"):
        receive(fleet, tmp_path, message(1))


@pytest.mark.parametrize("value", ["", " ", "no/such/file"])
def test_a_list_that_cannot_be_read_does_not_switch_signatures_off(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    monkeypatch.setenv(KEYS_VARIABLE, value)
    with pytest.raises(ConfigError, match=r"set and empty|cannot be read"):
        receive(fleet, tmp_path, message(1))


def test_what_cannot_be_signed_is_refused(keys: dict[str, tuple[bytes, str]]) -> None:
    private = keys["VIN1"][0]
    for content, key, problem in (
        (message(1)[:-1], private, "message 1 is cut off"),
        (sign_messages(message(1), private), private, "is signed already"),
        (message(1), b"no key", "not an unencrypted Ed25519"),
    ):
        with pytest.raises(InputError, match=problem):
            sign_messages(content, key)
