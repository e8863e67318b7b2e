"""Versions of Gram files with rollups name the files, and tell their drives for ever."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.delta import Change
from fleet_slip.errors import ConflictError, StorageError
from fleet_slip.grams.cohorts import outweighing
from fleet_slip.grams.rows import rollup
from fleet_slip.grams.rows.rollup import hash_numbers
from fleet_slip.maintenance.forget import forget
from fleet_slip.maintenance.marked_models import models_trained_on
from fleet_slip.maintenance.vacuum import vacuum
from fleet_slip.models.describe_winner import manifest_of
from fleet_slip.models.publish import publish
from fleet_slip.warehouse.audit import Forgettable
from tests.support.fleet_messages import messages_of
from tests.support.messages import START_S

CARS, DAY_S = 150, 86_400


@pytest.fixture(autouse=True)
def rolled_up() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollup, "ROWS_PER_CELL", 4)
        patch.setattr(outweighing, "MOST_GROUPS", 10)
        yield


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    """Two days of messages, a Gram file each, and a version of them."""
    fleet = fleet_slip.open(tmp_path / "data")
    for day in range(2):
        receive(fleet, tmp_path, day)
    fleet.publish("year", fleet.cohort().select(), force=True)
    return fleet


def receive(fleet: fleet_slip.Fleet, folder: Path, day: int) -> None:
    path = folder / f"day-{day}"
    path.write_bytes(messages_of(CARS, START_S + DAY_S * day, seed=day, label_follows=True))
    assert [report.received for report in fleet.receive(path)] == [CARS]


def drives(fleet: fleet_slip.Fleet) -> list[str]:
    files = fleet.warehouse.grams.snapshot().files
    every = [fleet.warehouse.grams.read(file.path, ["drive_id"])["drive_id"] for file in files]
    return sorted(name for some in every for name in some.to_pylist())


def told(fleet: fleet_slip.Fleet, version: int, names: list[str]) -> list[bool]:
    registry = fleet.registry()
    made = registry.trained_drives(registry.load("year", version).manifest)
    assert made is not None
    among: list[bool] = made.among(hash_numbers(pa.array(names))).tolist()
    return among


def kept(fleet: fleet_slip.Fleet) -> dict[str, int]:
    folder = Path(str(fleet.registry().folder_of("year")))
    return {path.name: path.stat().st_size for path in folder.iterdir()}


def test_a_version_names_files_and_no_drive(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    names = drives(fleet)
    sizes = kept(fleet)
    assert sum(size for name, size in sizes.items() if name.endswith((".tree", ".bin"))) < CARS * 8
    receive(fleet, tmp_path, 2)
    assert told(fleet, 1, names) == [True] * len(names)
    assert told(fleet, 1, [*drives(fleet), "unknown"]).count(True) == len(names)
    # Beside a cohort of a day, and of one that only rows tell.
    day = fleet.cohort("day < DATE '2024-05-02'")
    assert fleet.publish("year", day.select(), force=True).version.version == 2
    some = fleet.cohort("vehicle_id < 'CAR2'")
    assert fleet.publish("year", some.select(), force=True).version.version == 3
    of_day = [name for name in names if "20240501" in name]
    assert told(fleet, 2, names) == [name in of_day for name in names]
    assert told(fleet, 3, names) == [name < "CAR2" for name in names]
    assert models_trained_on(fleet.warehouse, [of_day[0]])[:2] == ["year@1", "year@2"]
    found = fleet.diff("year@1", "year@2").drives
    assert found is not None
    assert (found.only_one, found.only_other, found.both) == (CARS, 0, CARS)


def test_drives_are_told_when_their_files_are_gone(fleet: fleet_slip.Fleet, tmp_path: Path) -> None:
    names = drives(fleet)
    registry = fleet.registry()
    made = registry.trained_drives(registry.load("year", 1).manifest)
    assert made is not None
    before = made.salted()
    exported = fleet.export("year", to="json", output=tmp_path / "export")
    forget(fleet.warehouse, Forgettable("vehicle", "CAR7"), now=True)
    assert [name.startswith("drives-of-") for name in kept(fleet)].count(True) == 2
    assert told(fleet, 1, names) == [True] * len(names)
    assert models_trained_on(fleet.warehouse, [names[0]]) == ["year@1"]
    made = registry.trained_drives(registry.load("year", 1).manifest)
    assert made is not None
    assert np.array_equal(made.salted(), before)
    assert not any(
        name.encode() in Path(str(registry.folder_of("year")), one).read_bytes()
        for one in kept(fleet)
        for name in names
    )
    # A version of what is left has the car no more, and a version from elsewhere has it.
    fleet.publish("year", fleet.cohort().select(), force=True)
    assert told(fleet, 2, names) == [not name.startswith("CAR7-") for name in names]
    assert not fleet.verify().damage
    away = fleet_slip.open(tmp_path / "away")
    [document] = exported
    brought = away.import_model(document)
    there = away.registry().trained_drives(brought.manifest)
    assert there is not None
    assert np.array_equal(there.salted(), before)


def replace_files(fleet: fleet_slip.Fleet) -> None:
    """Write every Gram file again, as a merge does, so that none of before is in the table."""
    grams = fleet.warehouse.grams.snapshot()
    rows = pa.concat_tables(grams.table.read(file.path) for file in grams.files)
    add = [grams.table.write_file("received-signals", rows)]
    grams.commit(Change(add=add, remove=list(grams.files)))


def test_a_file_that_goes_while_a_version_is_published_is_not_lost(
    fleet: fleet_slip.Fleet, tmp_path: Path
) -> None:
    receive(fleet, tmp_path, 2)
    names = drives(fleet)
    selection = fleet.cohort().select()
    replace_files(fleet)
    registry = fleet.registry()
    publish(registry, manifest_of(selection, "year"), selection, force=True)
    assert vacuum(fleet.warehouse, 0).files
    assert told(fleet, 2, names) == [True] * len(names)


def test_a_version_of_files_that_are_gone_is_not_published(fleet: fleet_slip.Fleet) -> None:
    selection = fleet.cohort().select()
    other = manifest_of(selection, "other")
    replace_files(fleet)
    assert vacuum(fleet.warehouse, 0).files
    with pytest.raises(ConflictError, match="Publish it again"):
        publish(fleet.registry(), other, selection, force=True)
    assert not fleet.registry().versions("other")


def test_damage_is_told(fleet: fleet_slip.Fleet) -> None:
    names = drives(fleet)
    replace_files(fleet)
    vacuum(fleet.warehouse, 0)
    [gone, _] = sorted(name for name in kept(fleet) if name.startswith("drives-of-"))
    path = Path(str(fleet.registry().folder_of("year")), gone)
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(StorageError, match="damaged"):
        told(fleet, 1, names)
    assert models_trained_on(fleet.warehouse, ["unknown"]) == ["year@1"]
    assert any("year@1" in one.path for one in fleet.verify().damage)
