"""Gram rows without a log beside those with one: what every job makes of them, by the CLI."""

import json
from collections.abc import Callable
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.app import app
from fleet_slip.delta import Change
from fleet_slip.errors import FleetSlipError, RefusedError
from fleet_slip.grams.rows.gram_job import update_grams
from fleet_slip.maintenance.retention import Retention, retain
from fleet_slip.regression.exact.gram import Gram
from tests.support.logs import land, log_rows
from tests.support.messages import START_S, drive_counts, gram_of, message_of

DAY = date(2024, 5, 1)
SIGNALS = catalogue().gram_signals

Command = Callable[..., str]


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    return fleet_slip.open(tmp_path / "data")


@pytest.fixture
def command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Command:
    """A command on the data root; what it printed, on both streams."""

    def run(*words: str, code: int = 0) -> str:
        found, error = 0, ""
        try:
            app(["--root", str(tmp_path / "data"), *words])
        except SystemExit as ended:
            found = int(ended.code or 0)
        except FleetSlipError as raised:
            found, error = raised.exit_code, str(raised)
        said = capsys.readouterr()
        assert found == code, (error, said.err)
        return said.out if "--json" in words else said.out + said.err + error

    return run


def receive(fleet: fleet_slip.Fleet, tmp_path: Path, *messages: bytes) -> Any:
    path = tmp_path / f"m{len(list(tmp_path.iterdir()))}"
    path.write_bytes(b"".join(messages))
    (report,) = fleet.receive(path)
    return report


def log_of(seed: int, drive_id: str, car: str = "VIN1", day: date = DAY) -> Any:
    counts = dict(zip(SIGNALS, drive_counts(seed).T, strict=True))
    return log_rows(drive_id, counts, day, vehicle_id=car)


def drives(fleet: fleet_slip.Fleet) -> list[tuple[Any, ...]]:
    return fleet.sql("SELECT drive_id, source, rows FROM drives ORDER BY ALL").fetchall()


@pytest.mark.parametrize("name", ["trip-1", "VIN1-20240501T100000Z"])
def test_a_log_that_comes_after_its_message_takes_its_place(
    fleet: fleet_slip.Fleet, tmp_path: Path, command: Command, name: str
) -> None:
    receive(fleet, tmp_path, message_of(gram_of(1)), message_of(gram_of(2), "VIN2"))
    land(fleet.warehouse, "f", log_of(1, name))
    said = command("gram")
    assert "1 Gram row that cars had sent dropped" in " ".join(said.split())
    assert drives(fleet) == sorted(
        [(name, "simulated", 500), ("VIN2-20240501T100000Z", "received", 500)]
    )
    assert not fleet.gram().changed
    assert fleet.verify(full=True).damage == []


def test_a_log_of_other_rows_but_the_same_name_is_preferred(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    receive(fleet, tmp_path, message_of(gram_of(1)))
    land(fleet.warehouse, "f", log_of(7, "VIN1-20240501T100000Z"))
    assert fleet.gram().received_dropped == 1
    (row,) = fleet.sql("SELECT source, sums FROM grams").fetchall()
    assert row == ("simulated", list(gram_of(7).sums))


def test_drives_of_a_car_and_day_that_differ_all_count(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    receive(fleet, tmp_path, message_of(gram_of(1)))
    land(fleet.warehouse, "f", log_of(2, "a"), log_of(1, "b", "VIN2"))
    land(fleet.warehouse, "g", log_of(1, "c", day=date(2024, 5, 2)), day=date(2024, 5, 2))
    assert fleet.gram().received_dropped == 0
    assert len(drives(fleet)) == 4


@pytest.mark.parametrize("name", ["trip-1", "VIN1-20240501T100000Z"])
def test_a_message_of_a_drive_whose_log_is_here_is_refused(
    fleet: fleet_slip.Fleet, tmp_path: Path, name: str
) -> None:
    land(fleet.warehouse, "f", log_of(1, name))
    fleet.gram()
    report = receive(fleet, tmp_path, message_of(gram_of(1)), message_of(gram_of(2), "VIN2"))
    assert (report.received, dict(report.refused)) == (1, {"has a drive whose log is here": 1})


def test_what_a_feature_set_leaves_out_is_said(
    fleet: fleet_slip.Fleet, tmp_path: Path, command: Command
) -> None:
    land(fleet.warehouse, "f", *(log_of(i, f"d{i}", f"LOG{i}") for i in range(6)))
    update_grams(fleet.warehouse, feature_set="motion")
    fleet.gram()
    receive(fleet, tmp_path, *(message_of(gram_of(i), f"VIN{i}") for i in range(10, 14)))
    words = ("select", "--model", "ax,ay,yaw_rate", "--features")
    said = " ".join(command(*words, "motion").split())
    assert "6 drives" in said
    assert "4 drives without a log left out" in said
    assert "not of the feature set motion" in said
    said = " ".join(command(*words, "signals").split())
    assert "10 drives" in said
    assert "4 drives of these without a log" in said
    told = json.loads(command(*words, "motion", "--json"))
    assert (told["drives"], told["drives_without_log"], told["drives_left_out"]) == (6, 0, 4)
    said = command(*words, "motion", "--cohort", "source = 'received'", code=5)
    assert "sent Gram rows of the logged signals and no log" in " ".join(said.split())


def fill_days(fleet: fleet_slip.Fleet, tmp_path: Path, days: range, bias: int = 0) -> None:
    """Send what three cars drove on some days; the label of all is off by some counts."""
    messages = []
    for day in days:
        for car in range(3):
            counts = drive_counts(100 + car, 2000).astype(np.int64)
            random = np.random.default_rng([day, car])
            label = SIGNALS.index(catalogue().label)
            counts[:, label] = counts[:, SIGNALS.index("ay")] // 4 + random.integers(-9, 9, 2000)
            counts[:, label] += bias
            gram = Gram.from_counts(SIGNALS, counts)
            messages.append(message_of(gram, f"VIN{car}", START_S + 86_400 * day))
    receive(fleet, tmp_path, *messages)


def test_a_model_of_received_rows_is_monitored_on_received_rows(
    fleet: fleet_slip.Fleet, tmp_path: Path, command: Command
) -> None:
    fill_days(fleet, tmp_path, range(8))
    selection = fleet.cohort().select(model="ax,ay,yaw_rate")
    published = fleet.publish("cars", selection, force=True)
    assert published.version.manifest.trained_on.drives_without_log == 24
    since = str(DAY + timedelta(days=7))
    command("monitor", "cars", "--since", since)
    fill_days(fleet, tmp_path, range(8, 9), bias=400)
    said = command("monitor", "cars", "--since", since, code=10)
    assert "2024-05-09" in said


def test_monitor_says_what_a_feature_set_leaves_out(
    fleet: fleet_slip.Fleet, tmp_path: Path, command: Command
) -> None:
    for day in (DAY + timedelta(days=days) for days in range(6)):
        logs = [log_of(i, f"{day}-{i}", "A", day) for i in (1, 2)]
        land(fleet.warehouse, str(day), *logs, day=day)
    update_grams(fleet.warehouse, feature_set="motion")
    fleet.gram()
    selection = fleet.cohort().select(model="ax,ay,yaw_rate", features="motion")
    fleet.publish("cars", selection, force=True)
    receive(fleet, tmp_path, *(message_of(gram_of(i), f"VIN{i}") for i in range(10, 13)))
    words = ("monitor", "cars", "--since", str(DAY + timedelta(days=5)))
    said = " ".join(command(*words).split())
    assert "3 drives without a log left out" in said
    assert "not of the feature set motion" in said
    assert json.loads(command(*words, "--json"))["drives_left_out"] == 3


def test_retention_knows_the_days_of_received_rows(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    fill_days(fleet, tmp_path, range(60, 62))
    fill_days(fleet, tmp_path, range(1))
    retention = Retention(drives_days=30, replaced_files_hours=1)
    with pytest.raises(RefusedError, match=r"its latest drive is of 2024-07-01"):
        retain(fleet.warehouse, retention, date(2034, 1, 1))
    report = retain(fleet.warehouse, retention, date(2024, 7, 3))
    assert report.forgotten.drives == 3
    assert {str(day) for (day,) in fleet.sql("SELECT DISTINCT day FROM drives").fetchall()} == {
        "2024-06-30",
        "2024-07-01",
    }


@pytest.mark.parametrize(
    ("column", "value", "problem"),
    [
        ("sums", [10**9] * len(SIGNALS), "has sums outside the ranges of its signals"),
        ("n", 0, "has no rows, or more than a drive can have"),
        ("vehicle_id", "VIN2", "is of another car or day than its drive"),
        ("day", date(2024, 5, 2), "is of another car or day than its drive"),
        ("signals", "ax," * (len(SIGNALS) - 1) + "no_signal", "has signals that there are not"),
    ],
)
def test_verify_examines_received_rows_again(
    fleet: fleet_slip.Fleet,
    tmp_path: Path,
    command: Command,
    column: str,
    value: Any,
    problem: str,
) -> None:
    receive(fleet, tmp_path, message_of(gram_of(1)))
    grams = fleet.warehouse.grams
    snapshot = grams.snapshot()
    (file,) = snapshot.files
    rows = grams.read(file.path).to_pylist()
    rows[0][column] = value
    changed = type(grams.read(file.path)).from_pylist(rows, schema=grams.schema)
    snapshot.commit(Change(add=[grams.write_file("signals", changed)], remove=[file]))
    said = command("verify", code=9)
    assert problem in " ".join(said.split())


def test_repair_computes_rows_of_logs_again_and_keeps_what_cars_sent(
    fleet: fleet_slip.Fleet, tmp_path: Path, command: Command
) -> None:
    receive(fleet, tmp_path, message_of(gram_of(1)))
    land(fleet.warehouse, "f", log_of(2, "trip-1"))
    fleet.gram()
    before = drives(fleet)
    grams = fleet.warehouse.grams
    (own,) = [f.path for f in grams.snapshot().files if f.path.startswith("signals")]
    (sent,) = [f.path for f in grams.snapshot().files if f.path.startswith("received")]
    flip(tmp_path / "data" / "grams" / own)
    command("verify", code=9)
    command("verify", "--repair")
    assert drives(fleet) == before
    content = (tmp_path / "data" / "grams" / sent).read_bytes()
    flip(tmp_path / "data" / "grams" / sent)
    said = " ".join(command("verify", "--repair", code=9).split())
    assert sent in said
    assert any(f.path == sent for f in grams.snapshot().files)
    (tmp_path / "data" / "grams" / sent).write_bytes(content)
    command("verify")
    assert drives(fleet) == before


def flip(path: Path) -> None:
    """Change a byte of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
