"""Tables of Gram rows from cars land whole and once; what no drive can have is refused."""

import shutil
from collections.abc import Callable
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import InputError, RepeatedError
from fleet_slip.grams.on_board import (
    COLUMNS,
    INDEFINITE,
    MAX_ROWS_OF_A_DAY,
    NO_ROWS,
    PRODUCTS,
    SUMS,
    OnboardImport,
    find_impossible,
)
from fleet_slip.regression.gram import Gram
from tests.support.commands import RunCommand
from tests.support.counted_rows import START_S, gram_of, row_of, rows_of_fleet, write_counted
from tests.support.counts import table_of

DAY_S = 86_400


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return fleet_slip.open(tmp_path / "data")


Send = Callable[[list[dict[str, Any]]], OnboardImport]


@pytest.fixture
def send(fleet: Fleet, tmp_path: Path) -> Send:
    return lambda rows: fleet.import_onboard_grams(write_counted(tmp_path / "rows", rows))


def gram_rows(fleet: Fleet) -> list[dict[str, Any]]:
    if not fleet.warehouse.grams.snapshot().rows:
        return []
    rows: list[dict[str, Any]] = fleet.sql("FROM grams ORDER BY ALL").to_arrow_table().to_pylist()
    return rows


def test_rows_land_as_they_are_and_are_fitted(fleet: Fleet, send: Send) -> None:
    grams = [gram_of(seed) for seed in range(6)]
    rows = [row_of(gram, f"VIN{i}") for i, gram in enumerate(grams)]
    report = send(rows)
    assert (report.new, report.gram_rows, report.drives, report.rows) == (True, 6, 6, 3000)
    for row, gram in zip(gram_rows(fleet), grams, strict=True):
        assert (row["row_count"], tuple(row["sums"]), tuple(row["products"])) == (
            gram.n,
            gram.sums,
            gram.products,
        )
        assert (row["source"], row["day"]) == ("received", date(2024, 5, 1))
    selection = fleet.cohort().select(model="ax,ay")
    assert (selection.cohort.rows, selection.cohort.count_onboard_with()) == (3000, 6)
    assert "sent Gram rows of logged signals" in fleet.cohort().select().remark
    assert not fleet.maintenance.verify(full=True).findings


def test_the_same_file_counts_once_and_is_forgotten_for_good(fleet: Fleet, tmp_path: Path) -> None:
    rows = [row_of(gram_of(1), "VIN1"), row_of(gram_of(2), "VIN2")]
    path = write_counted(tmp_path / "rows", rows)
    fleet.import_onboard_grams(path)
    before = gram_rows(fleet)
    assert not fleet.import_onboard_grams(path).new
    assert gram_rows(fleet) == before
    fleet.maintenance.forget(vehicle="VIN1")
    assert [row["vehicle_id"] for row in gram_rows(fleet)] == ["VIN2"]
    again = write_counted(tmp_path / "again", [row_of(gram_of(3), "VIN1", START_S + DAY_S)])
    with pytest.raises(InputError, match=r"row 1 \(drive VIN1-.*\) was forgotten"):
        fleet.import_onboard_grams(again)
    assert [row["vehicle_id"] for row in gram_rows(fleet)] == ["VIN2"]


def other(gram: Gram, **changed: Any) -> dict[str, Any]:
    return row_of(gram, "VIN2", START_S + DAY_S, **changed)


GRAM = gram_of(2)
HERE = np.array(GRAM.products)
K = len(GRAM.signals)
NEGATIVE = HERE.copy()
NEGATIVE[1] = int((HERE[0] * HERE[2]) ** 0.5) + 10**6
TOO_LONG = (
    np.array(integers) * (MAX_ROWS_OF_A_DAY // 500 + 1) for integers in (GRAM.sums, GRAM.products)
)
LONG_SUMS, LONG_PRODUCTS = TOO_LONG


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"source": "smoke"}, "not have the source"),
        ({"vehicle_id": " "}, "no vehicle_id"),
        ({"drive_id": None}, "no drive_id"),
        ({"day": date(1999, 12, 31)}, "a day before 2000"),
        ({"day": date.today() + timedelta(days=3)}, "in the future"),
        ({"feature_set": "signals:0000000000000000"}, "defined differently here"),
        ({"part": "4 s"}, "a block that its feature set lacks"),
        ({"course_late": 3}, "a course delay that is missing, unexpected or out of range"),
        ({"signals": ",".join(reversed(GRAM.signals))}, "another order of signals"),
        ({"signals": "ax"}, "not have one sum a signal"),
        ({"n": 0}, "has no rows"),
        ({"sums": [None, *GRAM.sums[1:]]}, "null"),
        (
            {
                "n": 500 * (MAX_ROWS_OF_A_DAY // 500 + 1),
                "sums": LONG_SUMS.tolist(),
                "products": LONG_PRODUCTS.tolist(),
            },
            "exceeds 24 hours of driving of its car on a day",
        ),
        ({"sums": [10**9, *GRAM.sums[1:]]}, "sums outside the ranges"),
        ({"products": [2**50, *GRAM.products[1:]]}, "products outside the ranges"),
        ({"products": NEGATIVE.tolist()}, "not positive semidefinite"),
        ({"drive_id": "VIN1-20240501T100000Z"}, "another car or day"),
        ({"vehicle_id": "V" * 2_000_000}, "a vehicle_id that has more than 200 characters"),
        ({"drive_id": "V" * 201}, "a drive_id that has more than 200 characters"),
        ({"vehicle_id": "V\x1b[2J"}, "a vehicle_id that has characters that cannot be printed"),
    ],
)
def test_a_row_that_cannot_be_keeps_the_whole_file_out(
    fleet: Fleet, tmp_path: Path, changed: dict[str, Any], reason: str
) -> None:
    path = write_counted(tmp_path / "rows", [row_of(gram_of(1)), other(GRAM, **changed)])
    with pytest.raises(InputError, match=rf"rows: row [12] \(drive .*\) .*{reason}"):
        fleet.import_onboard_grams(path)
    assert gram_rows(fleet) == []


def test_a_drive_that_is_there_is_refused_under_any_name(fleet: Fleet, send: Send) -> None:
    send([row_of(gram_of(1))])
    for same in (row_of(gram_of(3)), row_of(gram_of(1), drive_id="renamed")):
        with pytest.raises(RepeatedError, match=r"row 2 .* is stored already, as VIN1-2024"):
            send([other(GRAM), same])
    with pytest.raises(InputError, match=r"row 2 .* appears twice"):
        send([other(GRAM), other(gram_of(5))])
    assert len(gram_rows(fleet)) == 1


@pytest.mark.parametrize(
    "change",
    [
        {"day": date(2024, 5, 2)},
        {"vehicle_id": "VIN2"},
        {"vehicle_id": "VIN2", "day": date(2024, 6, 1)},
        {},
    ],
)
def test_a_replay_is_refused_on_any_day_of_any_car(
    fleet: Fleet, send: Send, tmp_path: Path, change: dict[str, Any]
) -> None:
    replay = row_of(gram_of(1), drive_id="replay", **change)
    both = write_counted(tmp_path / "both", [row_of(gram_of(1)), replay])
    with pytest.raises(InputError, match=r"row 2 \(drive replay\) appears twice, first as VIN1-"):
        fleet.import_onboard_grams(both)
    send([row_of(gram_of(1))])
    with pytest.raises(RepeatedError, match="is stored already, as VIN1-2024"):
        send([replay])
    assert len(gram_rows(fleet)) == 1


def test_rows_of_a_standing_car_may_equal_those_of_another(
    fleet: Fleet, send: Send, tmp_path: Path
) -> None:
    standing = Gram.from_counts(GRAM.signals, np.zeros((3000, K), np.int64))
    rows = [row_of(standing, car) for car in ("VIN1", "VIN2")]
    send(rows)
    send([row_of(standing, "VIN3")])
    again = write_counted(tmp_path / "again", [row_of(standing, "VIN1", drive_id="again")])
    with pytest.raises(RepeatedError, match="is stored already, as VIN1-2024"):
        fleet.import_onboard_grams(again)


def long_drive(seed: int, rows: int, name: str) -> dict[str, Any]:
    times = rows // 500
    gram = gram_of(seed)
    sums = [times * value for value in gram.sums]
    products = [times * value for value in gram.products]
    return row_of(gram, drive_id=name, n=500 * times, sums=sums, products=products)


def test_a_car_drives_24_hours_a_day_at_most(fleet: Fleet, send: Send) -> None:
    drives = [long_drive(seed, MAX_ROWS_OF_A_DAY // 2, f"drive-{seed}") for seed in range(4)]
    reason = "exceeds 24 hours of driving of its car on a day"
    with pytest.raises(InputError, match=rf"row 3 \(drive drive-2\) {reason}"):
        send(drives[:3])
    send(drives[:1])
    send(drives[1:2])
    other = drives[2] | {"vehicle_id": "VIN2"}
    tomorrow = drives[3] | {"day": date(2024, 5, 2)}
    with pytest.raises(
        InputError, match=rf"row 1 \(drive drive-2\) {reason}, with the stored rows"
    ):
        send(drives[2:3])
    send([other, tomorrow])
    assert len(gram_rows(fleet)) == 4


@pytest.mark.parametrize("name", [" VIN1", "VIN1\t", "vin1"])
def test_an_erased_car_does_not_come_back_under_a_similar_name(
    fleet: Fleet, send: Send, name: str
) -> None:
    rows = [row_of(gram_of(1), "VIN1"), row_of(gram_of(2), "VIN2")]
    send(rows)
    fleet.maintenance.forget(vehicle="VIN1")
    with pytest.raises(InputError, match="was forgotten"):
        send([row_of(gram_of(3), name, drive_id="a")])


@pytest.mark.parametrize("subject", [{"drive": "VIN1-20240501T100000Z"}, {"vehicle": "VIN1"}])
def test_an_erased_drive_is_refused_under_another_name_until_it_is_allowed(
    fleet: Fleet, send: Send, tmp_path: Path, subject: dict[str, Any]
) -> None:
    rows = [row_of(gram_of(1)), row_of(gram_of(2), "VIN2")]
    send(rows)
    assert fleet.maintenance.forget(**subject).drives == 1
    again = row_of(gram_of(1), "pseudonym", START_S + DAY_S)
    path = write_counted(tmp_path / "again", [again])
    with pytest.raises(InputError, match="has the counts of a drive that was forgotten"):
        fleet.import_onboard_grams(path)
    fleet.maintenance.allow(**subject)
    assert fleet.import_onboard_grams(path).new


def test_an_erased_drive_with_a_log_does_not_come_back_as_gram_rows(
    smoke_copy: Path, tmp_path: Path
) -> None:
    fleet = fleet_slip.open(smoke_copy)
    same, drive = renamed(fleet, "other")
    fleet.maintenance.forget(drive=drive)
    again = write_counted(tmp_path / "rows", [same | {"vehicle_id": "pseudonym"}])
    with pytest.raises(InputError, match="has the counts of a drive that was forgotten"):
        fleet.import_onboard_grams(again)


def renamed(fleet: Fleet, name: str) -> tuple[dict[str, Any], str]:
    """Return the row of a logged drive as if a car had counted it, and the drive's own name."""
    row = fleet.sql("FROM grams WHERE feature_set = 'signals' ORDER BY drive_id LIMIT 1")
    (stored,) = row.to_arrow_table().to_pylist()
    signals = tuple(stored["signals"].split(","))
    gram = Gram(signals, stored["row_count"], tuple(stored["sums"]), tuple(stored["products"]))
    same = {"vehicle_id": stored["vehicle_id"], "day": stored["day"]}
    return row_of(gram, drive_id=name, **same), stored["drive_id"]


def test_a_drive_with_a_log_is_refused(smoke_copy: Path, tmp_path: Path) -> None:
    fleet = fleet_slip.open(smoke_copy)
    same, _ = renamed(fleet, "other")
    path = write_counted(tmp_path / "rows", [same])
    with pytest.raises(RepeatedError, match="is stored already"):
        fleet.import_onboard_grams(path)


def test_pages_need_checksums_and_a_flipped_bit_is_found(fleet: Fleet, tmp_path: Path) -> None:
    table = rows_of_fleet(20, START_S, seed=1)
    path = tmp_path / "rows"
    for options in ({}, {"use_dictionary": False}, {"compression": "none"}):
        pq.write_table(table, path, **options)
        with pytest.raises(InputError, match="no checksums"):
            fleet.import_onboard_grams(path)
    pq.write_table(table, path, write_page_checksum=True, compression="none")
    content = bytearray(path.read_bytes())
    at = content.index(np.array(table["products"][7].as_py()[3:5], np.int64).tobytes())
    content[at] ^= 2
    path.write_bytes(content)
    with pytest.raises(InputError, match="table of Gram rows"):
        fleet.import_onboard_grams(path)
    assert gram_rows(fleet) == []


def test_a_file_that_is_no_table_is_refused(fleet: Fleet, send: Send, tmp_path: Path) -> None:
    table = rows_of_fleet(3, START_S, seed=1).drop_columns(["part", "course_late"])
    assert send(table).gram_rows == 3
    (tmp_path / "text").write_text("FSGR")
    with pytest.raises(InputError, match="table of Gram rows"):
        fleet.import_onboard_grams(tmp_path / "text")
    write_counted(tmp_path / "lacks", rows_of_fleet(3, START_S, seed=1).drop_columns(["n"]))
    with pytest.raises(InputError, match="column n is missing"):
        fleet.import_onboard_grams(tmp_path / "lacks")
    write_counted(tmp_path / "empty", pa.Table.from_pylist([], schema=COLUMNS))
    with pytest.raises(InputError, match="has no Gram rows"):
        fleet.import_onboard_grams(tmp_path / "empty")


def test_the_command_says_what_landed(run_command: RunCommand, tmp_path: Path) -> None:
    path = write_counted(tmp_path / "rows.parquet", [row_of(gram_of(1))])
    done = run_command("--root", str(tmp_path / "data"), "ingest", str(path))
    assert done.exit_code == 0
    assert f"{path}: 1 Gram row of 1 drive, 500 rows" in done.stderr + done.stdout
    done = run_command("--root", str(tmp_path / "data"), "ingest", str(path))
    assert "nothing to do" in done.stderr + done.stdout


def test_rows_of_a_drive_go_when_its_log_comes(
    fleet: Fleet, send: Send, smoke_root: Path, tmp_path: Path
) -> None:
    same, drive = renamed(fleet_slip.open(smoke_root), "renamed")
    other = row_of(gram_of(1), drive_id=drive)  # the same name, and other counts
    rows = [same, other, row_of(gram_of(2), "VIN2")]
    send(rows)
    shutil.copytree(smoke_root / "logs", tmp_path / "data" / "logs")
    report = fleet.gram()
    assert report.received_dropped == 2
    remaining = {row["drive_id"] for row in gram_rows(fleet) if row["source"] == "received"}
    assert len(remaining) == 1 and remaining.pop().startswith("VIN2")
    assert not fleet.gram().changed


RANGES = [(-100, 100), (0, 30000), (-32767, 32767)]


@st.composite
def counts(draw: st.DrawFn) -> Any:
    rows = draw(st.integers(1, 12))
    columns = [st.one_of(st.sampled_from(r), st.integers(*r)) for r in RANGES]
    return np.array([[draw(column) for column in columns] for _ in range(rows)], np.int64)


@settings(max_examples=200)
@given(counts())
def test_sums_of_real_counts_are_accepted(rows: Any) -> None:
    assert find_impossible(table_of([Gram.from_counts("abc", rows)]), RANGES) == {}


@pytest.mark.parametrize("value", [-32767, 0, 1, 32767])
def test_the_longest_drive_at_the_ends_of_the_ranges_is_possible(value: int) -> None:
    n = 2**31 - 1
    gram = Gram(("a", "b"), n, (n * value, n * value), (n * value**2,) * 3)
    assert find_impossible(table_of([gram]), [(-32767, 32767)] * 2) == {}


DRIVE = Gram.from_counts("abc", np.array([[3, 5, -7], [4, 5, 900], [-2, 8, 11], [3, 0, 1]]))


@pytest.mark.parametrize(
    ("field", "place", "change", "reason"),
    [
        ("n", 0, -4, NO_ROWS),
        ("n", 0, 2**31, NO_ROWS),
        ("sums", 0, 1000, SUMS),
        ("sums", 1, -100, SUMS),
        ("products", 0, -38, INDEFINITE),
        ("products", 5, 2**62, PRODUCTS),
        ("products", 5, -(2**63) + 1, PRODUCTS),
        ("products", 1, 4 * 100 * 30000 + 1, PRODUCTS),
        ("products", 4, 50_000, INDEFINITE),
        ("products", 3, -50_000, INDEFINITE),
    ],
)
def test_impossible_sums_are_reported(field: str, place: int, change: int, reason: str) -> None:
    table = table_of([DRIVE])
    getattr(table, field).reshape(-1)[place] += np.int64(change)
    assert find_impossible(table, RANGES) == {0: reason}


def test_names_are_stored_without_spaces_and_composed(fleet: Fleet, send: Send) -> None:
    row = row_of(gram_of(1), " Zoe\u0308 ", drive_id="d1\n")
    send([row])
    ((stored),) = gram_rows(fleet)
    assert (stored["vehicle_id"], stored["drive_id"]) == ("Zo\u00eb", "d1")
