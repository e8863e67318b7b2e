"""Rollups of files in an object store are read by themselves: a range of each object."""

from pathlib import Path

import pytest

from fleet_slip.files import object_files
from fleet_slip.files.folder import Folder
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.cohorts.fold_sums import SummedCohort, sum_cohort
from fleet_slip.grams.cohorts.folding import Folding
from fleet_slip.grams.received.receiving import receive_files
from fleet_slip.warehouse.tables import Warehouse
from tests.support.fleet_messages import messages_of
from tests.support.messages import START_S

CARS = 1000


def received(root: Folder, folder: Path) -> SummedCohort:
    path = folder / "messages"
    path.write_bytes(messages_of(CARS, START_S, seed=1))
    [report] = receive_files(Warehouse(root), [path])
    assert report.received == CARS
    return sum_cohort(Warehouse(root), Folding())


def test_a_cohort_is_added_up_without_fetching_an_object(
    root: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = received(LocalFolder(tmp_path / "data"), tmp_path)
    fetched: list[str] = []
    fetch = object_files._fetch

    def noted(store: object, key: str, where: str) -> bytes:
        fetched.append(key)
        return fetch(store, key, where)  # type: ignore[arg-type]

    monkeypatch.setattr(object_files, "_fetch", noted)
    there = received(root, tmp_path)
    assert there.sums.tables == here.sums.tables
    assert there.drive_count == CARS
    assert there.members.count_vehicles_with(()) == CARS
    assert not fetched
