"""Rollups change no bit of an answer, and go with the rows that they are of."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fleet_slip
from fleet_slip.delta import Change
from fleet_slip.errors import FleetSlipError, StorageError
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.cohorts import outweighing, rollup_cells
from fleet_slip.grams.cohorts.day_sums import sum_days
from fleet_slip.grams.cohorts.fold_sums import sum_cohort
from fleet_slip.grams.cohorts.folding import EACH, FoldCount, Folding, FoldKey
from fleet_slip.grams.cohorts.gram_reader import GramReader
from fleet_slip.grams.received.car_keys import KEYS_VARIABLE
from fleet_slip.grams.rows import rollup
from fleet_slip.grams.rows.gram_files import write_rows
from fleet_slip.grams.rows.rollup import Rollup, hash_numbers, make_rollup, read_rollup
from fleet_slip.maintenance.retention import Retention, retain
from fleet_slip.models.versions import Registry
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.warehouse.condition import parse_condition
from fleet_slip.warehouse.tables import Warehouse
from tests.support.fleet_messages import messages_of
from tests.support.growth_history import FIRST_DAY, SIGNALS, Drives, day_of, write_logs
from tests.support.messages import START_S, gram_of, message_of

CARS = 150
INPUTS = tuple(SIGNALS[:4])
DAY_S = 86_400


@pytest.fixture(scope="module", autouse=True)
def rolled_up_by_many_columns() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollup, "ROWS_PER_CELL", 4)
        patch.setattr(outweighing, "MOST_GROUPS", 10)  # 60 groups of 150 cars differ
        yield


def receive(fleet: fleet_slip.Fleet, folder: Path, days: range) -> None:
    """Receive the messages of each day by themselves: a Gram file each."""
    for day in days:
        path = folder / f"day-{day}"
        path.write_bytes(messages_of(CARS, START_S + DAY_S * day, seed=day))
        assert [report.received for report in fleet.receive(path)] == [CARS]


def write_logged(warehouse: Warehouse, drives: int) -> None:
    """Logs of one drive each, and their Gram rows in two files, as the Gram job writes them."""
    paths = write_logs(warehouse, drives)
    half = drives // 2
    add = []
    for first in (0, half):
        drawn = Drives.drawn(first, half, 1)
        files, days = zip(*((paths[i], day_of(i)) for i in range(first, first + half)), strict=True)
        add += write_rows(warehouse, [drawn.grams(warehouse, files, days)])
    warehouse.grams.snapshot().commit(Change(add=add))


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Warehouse:
    """Drives with logs and without, in files with rollups and without, of two sets of signals."""
    folder = tmp_path_factory.mktemp("mixed")
    fleet = fleet_slip.open(folder / "data")
    write_logged(fleet.warehouse, 400)
    receive(fleet, folder, range(2))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollup, "ROWS_PER_CELL", 10**6)  # a file of an earlier version
        receive(fleet, folder, range(2, 3))
    rows = Drives.drawn(1000, 200, 1).grams(fleet.warehouse, [""] * 200, [FIRST_DAY] * 200)
    fewer = rows.set_column(
        rows.column_names.index("signals"), "signals", pa.repeat(",".join(SIGNALS[:-2]), 200)
    )
    k = len(SIGNALS) - 2
    sizes = {"sums": k, "products": k * (k + 1) // 2}
    for name, size in sizes.items():
        lists = pa.array([one[:size] for one in rows[name].to_pylist()], pa.list_(pa.int64()))
        fewer = fewer.set_column(fewer.column_names.index(name), name, lists)
    both = pa.concat_tables([rows.slice(0, 120), fewer.slice(60)])  # sixty drives have two rows
    files = pa.repeat("received/made-up", len(both))
    both = both.set_column(both.column_names.index("file"), "file", files)
    add = write_rows(fleet.warehouse, [both])
    fleet.warehouse.grams.snapshot().commit(Change(add=add))
    return fleet.warehouse


def rollups_of(warehouse: Warehouse) -> dict[str, Rollup]:
    every = {f.path: read_rollup(warehouse.grams, f.path) for f in warehouse.grams.snapshot().files}
    return {path: one for path, one in every.items() if one}


def served(warehouse: Warehouse, condition: str, by: FoldKey, count: FoldCount) -> int:
    """Of how many files the rollups serve."""
    with GramReader(warehouse) as reader:
        parsed = parse_condition(condition)
        return len(reader.opened("signals", parsed, Folding(by=by, count=count)).cells.paths)


def outcome(warehouse: Warehouse, folding: Folding, condition: str) -> Any:
    """All that a selection takes from a cohort, or the error."""
    try:
        cohort = sum_cohort(warehouse, folding, condition)
    except FleetSlipError as error:
        return type(error), str(error)
    members, every = cohort.members, []
    for inputs in (INPUTS, SIGNALS):
        try:
            of_inputs: Any = cohort.sums.serving(inputs[:-1], inputs[-1], sparse=True)
        except FleetSlipError as error:
            of_inputs = str(error)
        told = members.count_vehicles_with(inputs), members.count_received_with(inputs)
        every.append((of_inputs, told, members.drives_with(inputs).tolist()))
    sums = cohort.sums
    counts = cohort.rows, cohort.drive_count, members.count_received
    return sums.names, sums.tables, counts, cohort.inputs, every


def days_of(warehouse: Warehouse, condition: str) -> Any:
    try:
        return sum_days(warehouse, INPUTS, condition)
    except FleetSlipError as error:
        return type(error), str(error)


ATOMS = st.sampled_from(
    [
        "true",
        "source = 'received'",
        "source <> 'received'",
        "campaign IS NULL",
        "vehicle_model IN ('model_1', 'model_3')",
        "track = 'track_0'",
        "adhesion < 0.8",
        "mass_kg > 1300",
        "saturated = 0",
        "day >= DATE '2024-05-02'",
        "day < DATE '2020-01-10'",
        "vehicle_id <> 'CAR7'",
        "drive_id LIKE '%3%'",
        "CAST(campaign AS INTEGER) = 1",
    ]
)
CONDITIONS = st.recursive(
    ATOMS,
    lambda part: st.one_of(
        st.builds("NOT ({})".format, part),
        st.builds("({} AND {})".format, part, part),
        st.builds("({} OR {})".format, part, part),
    ),
    max_leaves=4,
)
FOLDINGS = st.builds(
    Folding,
    by=st.sampled_from(["drive", "vehicle", "track", "day", "mass", "adhesion", "speed"]),
    count=st.one_of(st.integers(2, 61), st.just(EACH)),
)


@settings(max_examples=10)  # each asks four times for all of a cohort: 0.7 s
@given(folding=FOLDINGS, condition=CONDITIONS)
def test_any_cohort_over_any_folds_is_the_same_with_rollups_and_without(
    mixed: Warehouse, folding: Folding, condition: str
) -> None:
    by_cells = outcome(mixed, folding, condition), days_of(mixed, condition)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollup_cells, "read_rollup", lambda *_: None)
        by_rows = outcome(mixed, folding, condition), days_of(mixed, condition)
    assert by_cells == by_rows


@pytest.mark.parametrize(
    ("condition", "by", "count", "files"),
    [
        ("true", "drive", 5, 5),
        ("source = 'received' AND day >= DATE '2024-05-01'", "drive", 60, 5),
        ("true", "vehicle", 10, 5),
        ("true", "day", EACH, 5),
        ("vehicle_model IS NULL", "track", EACH, 5),
        ("adhesion < 0.8", "drive", 5, 2),  # of the logged drives there are too many values
        ("true", "drive", 7, 0),
        ("true", "drive", EACH, 0),
        ("vehicle_id <> 'CAR7'", "drive", 5, 0),
        ("source = 'nowhere'", "drive", 5, 5),
    ],
)
def test_rollups_serve_what_they_can(
    mixed: Warehouse, condition: str, by: FoldKey, count: FoldCount, files: int
) -> None:
    assert served(mixed, condition, by, count) == files


def test_a_selection_reads_no_row_of_a_file_whose_rollup_serves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    receive(fleet, tmp_path, range(3))
    whole = fleet.cohort().select(models="table1")
    for file in (tmp_path / "data/grams").glob("*.parquet"):
        stop = len(file.read_bytes()) // 2
        file.write_bytes(file.read_bytes()[:stop])  # the rows are gone, not what is before them
    assert fleet.cohort().select(models="table1").as_dict() == whole.as_dict()
    monkeypatch.setattr(rollup_cells, "read_rollup", lambda *_: None)
    with pytest.raises(StorageError, match=r"was damaged|ended|damaged"):
        fleet.cohort().select(models="table1")


@pytest.mark.parametrize("at", [100, 2000, -1])
def test_a_damaged_rollup_is_told_and_never_used(tmp_path: Path, at: int) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    receive(fleet, tmp_path, range(2))
    (file, *_) = (tmp_path / "data/grams").glob("*.parquet")
    content = bytearray(file.read_bytes())
    at = content.index(b"FSPF") if at < 0 else at  # then it seems to have none: rows are read
    content[at] ^= 1
    file.write_bytes(content)
    with pytest.raises(StorageError, match="damaged"):
        fleet.cohort().select(models="table1")
    assert any(file.name in damage.path for damage in fleet.verify().damage)


def test_a_rollup_of_other_rows_is_found(tmp_path: Path) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    receive(fleet, tmp_path, range(2))
    assert fleet.verify().damage == []
    grams = fleet.warehouse.grams.snapshot()
    one, other = grams.files
    foreign = make_rollup(grams.table.read(other.path))
    action = grams.table.write_file("received-signals", grams.table.read(one.path), leading=foreign)
    grams.commit(Change(add=[action], remove=[one]))
    (found,) = fleet.verify().damage
    assert (found.kind, "its rollup is not" in found.problem) == ("gram", True)


def test_what_is_forgotten_is_in_no_rollup(tmp_path: Path) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    receive(fleet, tmp_path, range(3))
    car, drive = hash_numbers(pa.array(["CAR7", "CAR7-20240501T100000Z"]))
    before = rollups_of(fleet.warehouse)
    assert all(car in one.vehicles() for one in before.values())
    fleet.forget(vehicle="CAR7", now=True)
    after = rollups_of(fleet.warehouse)
    assert after
    assert not before.keys() & after.keys()
    for one in after.values():
        mine = one.cells.filter(pa.compute.equal(one.cells["key"], "drive"))
        assert car not in one.vehicles()
        assert drive not in one.drives(mine)
    assert not any((tmp_path / "data/grams" / path).exists() for path in before)
    assert sum_cohort(fleet.warehouse, Folding()).drive_count == 3 * (CARS - 1)
    assert fleet.verify().damage == []
    day = (FIRST_DAY.replace(year=2024, month=5, day=1) + timedelta(days=1)).isoformat()
    retention = Retention(drives_days=1, replaced_files_hours=1)
    retain(fleet.warehouse, retention, FIRST_DAY.fromisoformat(day) + timedelta(days=1))
    assert sum_cohort(fleet.warehouse, Folding()).drive_count == 2 * (CARS - 1)


def test_gram_rows_whose_log_is_gone_do_not_count_in_rollups(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    write_logged(warehouse, 200)
    logs = warehouse.logs.snapshot()
    logs.commit(Change(remove=[logs.files[0]]))
    assert served(warehouse, "true", "drive", 5) == 1
    assert sum_cohort(warehouse, Folding()).drive_count == 199


def test_what_a_revoked_key_signed_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    receive(fleet, tmp_path, range(2))
    path = tmp_path / "keys.csv"
    key = "MCowBQYDK2VwAyEAGb9ECWmEzf6FQbrBZ9w7lshQhqowtrbLDFw4rXAxZuE="
    path.write_text(
        "vehicle_id,public_key,valid_from,valid_until,revoked_since\n"
        f"CAR7,{key},,,2024-05-02\nELSE,{key},,,2024-05-01\n"
    )
    monkeypatch.setenv(KEYS_VARIABLE, str(path))
    cohort = sum_cohort(fleet.warehouse, Folding())
    assert (cohort.drive_count, dict(cohort.revoked)) == (2 * CARS - 1, {"CAR7": 1})
    path.write_text(path.read_text().replace("CAR7", "NONE"))
    assert served(fleet.warehouse, "true", "drive", 5) == 2


def test_versions_know_the_drives_of_rollups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifests, drives = [], []
    for name in ("cells", "rows"):
        fleet = fleet_slip.open(tmp_path / name)
        receive(fleet, tmp_path, range(2))
        fleet.publish("made", fleet.cohort().select(), force=True)
        first = fleet.cohort("day = DATE '2024-05-01'").select()
        fleet.publish("made", first, force=True)  # beside the champion
        registry = Registry(fleet.warehouse.root / "models")
        made = [registry.load("made", number).manifest for number in (1, 2)]
        drives.append([fleet.registry().trained_drives(one) for one in made])
        told = {"drives_sha256": None, "files_sha256": None}
        alike = [one.trained_on.model_copy(update=told) for one in made]
        manifests.append(
            [one.model_copy(update={"trained_on": t}) for one, t in zip(made, alike, strict=True)]
        )
        monkeypatch.setattr(rollup_cells, "read_rollup", lambda *_: None)
    assert manifests[0] == manifests[1]
    for of_cells, of_rows in zip(*drives, strict=True):
        assert len(of_cells.files) > len(of_rows.files) == 0
        assert np.array_equal(of_cells.salted(), of_rows.salted())
    assert manifests[0][0].trained_on.vehicles == CARS
    assert manifests[0][0].trained_on.drives_without_log == 2 * CARS


def rows_of(**changes: Any) -> pa.Table:
    warehouse = Warehouse(LocalFolder(Path("nowhere")))
    rows = Drives.drawn(0, 200, 1).grams(warehouse, ["f"] * 200, [FIRST_DAY] * 200)
    for name, value in changes.items():
        at, kind = rows.column_names.index(name), rows.schema.field(name).type
        values = value if isinstance(value, list) else [value] * 200
        rows = rows.set_column(at, name, pa.array(values, kind))
    return rows


def test_files_that_a_rollup_could_be_wrong_of_have_none() -> None:
    assert make_rollup(rows_of())
    assert not make_rollup(rows_of(part="1"))
    assert not make_rollup(rows_of(trip_id="a trip"))
    assert not make_rollup(rows_of(started_at=datetime(2024, 5, 1, tzinfo=UTC)))
    assert not make_rollup(rows_of(vehicle_id=None))
    assert not make_rollup(rows_of(signals=""))
    assert not make_rollup(rows_of(day=[FIRST_DAY + timedelta(days=i) for i in range(200)]))
    assert len(make_rollup(rows_of(day=[FIRST_DAY + timedelta(days=i % 40) for i in range(200)])))
    assert not make_rollup(rows_of().slice(0, 3))


def test_sums_of_more_than_64_bits_are_left_to_the_rows() -> None:
    k = len(SIGNALS)
    products = np.zeros((200, k * (k + 1) // 2), dtype=np.int64)
    products[:, 5] = 2**61
    assert not make_rollup(rows_of(products=products.tolist()))
    products[1:, 5] = -(2**40)  # one such drive does not cost the others theirs
    assert make_rollup(rows_of(products=products.tolist()))


def test_a_car_that_outweighs_the_others_is_left_out_of_files_with_rollups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outweighing, "MOST_GROUPS", 2)
    fleet = fleet_slip.open(tmp_path / "data")
    receive(fleet, tmp_path, range(2))
    gram = gram_of(1, 8640)
    sums, products = ([1000 * number for number in some] for some in (gram.sums, gram.products))
    day = Gram(gram.signals, 1000 * gram.n, tuple(sums), tuple(products))
    content = message_of(day, "LIAR", START_S + 2 * DAY_S)
    (tmp_path / "m").write_bytes(content + messages_of(CARS, START_S + 2 * DAY_S, seed=2))
    fleet.receive(tmp_path / "m")
    assert len(rollups_of(fleet.warehouse)) == 3
    folding = Folding(by="vehicle", count=5)
    (left_out,) = sum_cohort(fleet.warehouse, folding, "true").outweighing
    assert (left_out.vehicle_id, left_out.drives) == ("LIAR", 1)
    found = outcome(fleet.warehouse, folding, "true")
    assert found == outcome(fleet.warehouse, folding, "vehicle_id <> 'LIAR'")
    monkeypatch.setattr(rollup_cells, "read_rollup", lambda *_: None)
    assert found == outcome(fleet.warehouse, folding, "true")
