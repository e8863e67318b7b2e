"""Erased cars in restored old tables: no view or cohort has them, and status reports them."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.errors import DataError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.forget import forget
from fleet_slip.operations.status import status_of
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change
from fleet_slip.warehouse.erasure_log import ErasureLog, ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import RunCommand
from tests.support.logs import ask, land, log_rows, random_counts

CARS = ("alfa", "beta")


def filled(root: Path, *, grams: bool = True) -> Warehouse:
    """Return a warehouse of two cars with two drives each, every file with both cars."""
    warehouse = Warehouse(LocalFolder(root))
    rng = np.random.default_rng(3)
    for number in range(2):
        drives = [
            log_rows(f"{car}-{number}", random_counts(rng, 50), vehicle_id=car) for car in CARS
        ]
        land(warehouse, f"f{number}", *drives)
    if grams:
        update_grams(warehouse)
    return warehouse


def restored(root: Path, subject: ErasureSubject, *, grams: bool = True) -> Warehouse:
    """Return a warehouse whose tables are older than the erasure of a subject."""
    warehouse = filled(root / "data", grams=grams)
    for table in ("logs", "grams"):
        if (root / "data" / table).exists():
            shutil.copytree(root / "data" / table, root / "backup" / table)
    forget(warehouse, subject, now=True)
    for table in ("logs", "grams"):
        shutil.rmtree(root / "data" / table)
        if (root / "backup" / table).exists():
            shutil.copytree(root / "backup" / table, root / "data" / table)
    return Warehouse(LocalFolder(root / "data"))


@pytest.mark.parametrize("grams", [True, False])
@pytest.mark.parametrize(
    ("subject", "remaining"),
    [
        (ErasureSubject("vehicle", "beta"), {"alfa-0", "alfa-1"}),
        (ErasureSubject("drive", "beta-1"), {"alfa-0", "alfa-1", "beta-0"}),
    ],
)
def test_no_view_has_an_erased_subject_of_restored_tables(
    tmp_path: Path, subject: ErasureSubject, remaining: set[str], grams: bool
) -> None:
    warehouse = restored(tmp_path, subject, grams=grams)
    for view in ("log_counts", "log", "drives", *(["grams"] if grams else [])):
        rows = ask(warehouse.root, f"SELECT DISTINCT drive_id FROM {view}")
        assert {name for (name,) in rows} == remaining, view


def test_a_cohort_of_restored_tables_is_without_the_erased_car(tmp_path: Path) -> None:
    warehouse = restored(tmp_path, ErasureSubject("vehicle", "beta"))
    assert set(load_cohort(warehouse).drives["vehicle_id"].to_pylist()) == {"alfa"}
    with pytest.raises(DataError, match="no drive"):
        load_cohort(warehouse, "vehicle_id = 'beta'")
    update_grams(warehouse)
    assert set(load_cohort(warehouse).drives["vehicle_id"].to_pylist()) == {"alfa"}


def test_rows_without_a_name_of_a_car_stay(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    rng = np.random.default_rng(3)
    land(warehouse, "a", log_rows("anonymous", random_counts(rng, 50), vehicle_id=None))
    land(warehouse, "b", log_rows("beta-0", random_counts(rng, 50), vehicle_id="beta"))
    ErasureLog(warehouse.root).begin(ErasureSubject("vehicle", "beta"), 1, [])
    assert ask(warehouse.root, "SELECT drive_id FROM drives") == [("anonymous",)]


def test_refused_rows_of_an_erased_car_are_not_shown(tmp_path: Path) -> None:
    warehouse = filled(tmp_path)
    rows = [{"vehicle_id": "beta", "drive_id": "x"}, {"vehicle_id": None, "drive_id": None}]
    table = pa.Table.from_pylist(rows, schema=warehouse.quarantine.schema)
    action = warehouse.quarantine.write_file("refused", table)
    warehouse.quarantine.snapshot().commit(Change(add=[action]))
    ErasureLog(warehouse.root).begin(ErasureSubject("vehicle", "beta"), 2, [])
    assert ask(warehouse.root, "SELECT vehicle_id FROM quarantine") == [(None,)]


def test_status_reports_restored_rows_until_they_are_erased_again(
    tmp_path: Path, run_command: RunCommand
) -> None:
    restored(tmp_path, ErasureSubject("vehicle", "beta"))
    status = run_command("status")
    assert status.exit_code == 10
    command = "fleet-slip forget --vehicle beta --now"
    assert "the tables have rows of 1 erased name again" in status.stderr
    assert command in status.stderr
    assert run_command(*command.split()[1:]).exit_code == 0
    assert run_command("status").exit_code == 0


def test_an_erasure_that_is_under_way_is_hidden_and_no_problem(tmp_path: Path) -> None:
    warehouse = filled(tmp_path)
    ErasureLog(warehouse.root).begin(ErasureSubject("vehicle", "beta"), 2, [])
    assert ask(warehouse.root, "SELECT DISTINCT vehicle_id FROM drives") == [("alfa",)]
    assert not any("erased" in problem for problem in status_of(warehouse).problems)
