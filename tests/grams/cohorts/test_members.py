"""Which drives and cars have some signals, and a part of a cohort whose drives have not all."""

import numpy as np
import pyarrow as pa

from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.gram_files import hash_numbers
from fleet_slip.grams.job import update_grams
from fleet_slip.warehouse.condition import parse_condition
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, random_counts

ROWS = [("a", "ax,ay"), ("b", "ax,ay"), ("b", "ax,ay,yaw_rate"), ("c", "ax,ay,yaw_rate")]
"""Drive b has rows of both kinds; c came without a log."""


def hashes(names: list[str]) -> list[int]:
    return sorted(hash_numbers(pa.array(names)).tolist())


def cohort() -> Cohort:
    columns = {
        "drive_hash": hash_numbers(pa.array([drive for drive, _ in ROWS])),
        "vehicle_hash": [7] * len(ROWS),
        "source": ["received" if drive == "c" else "simulated" for drive, _ in ROWS],
        "signals": [signals for _, signals in ROWS],
        "n": [10] * len(ROWS),
    }
    return Cohort(
        condition=parse_condition("true"),
        logs_version=1,
        grams_version=1,
        drives=pa.table(columns),
    )


def test_drives_with_signals_are_those_of_rows_that_have_them_all() -> None:
    assert cohort().hash_drives_with(["ay", "ax"]).tolist() == hashes(["a", "b", "c"])
    assert cohort().hash_drives_with(["ay", "yaw_rate"]).tolist() == hashes(["b", "c"])
    assert cohort().hash_drives_with(["yaw"]).tolist() == []


def test_a_car_counts_once() -> None:
    assert cohort().count_vehicles_with(["ax"]) == 1
    assert cohort().count_vehicles_with(["steering_wheel"]) == 0
    assert cohort().count_received_with(["ax"]) == 1
    assert (cohort().rows, cohort().drive_count) == (40, 3)


def test_the_statement_hashes_names_as_python_does(warehouse: Warehouse) -> None:
    land(warehouse, "one", log_rows("dé", random_counts(np.random.default_rng(1), 40)))
    update_grams(warehouse)
    cohort = load_cohort(warehouse)
    for name in ("drive", "vehicle"):
        told = hash_numbers(cohort.drives[f"{name}_id"])
        assert cohort.drives[f"{name}_hash"].to_pylist() == told.tolist()


def test_a_part_of_a_cohort_has_the_tables_of_its_drives_alone(warehouse: Warehouse) -> None:
    rng = np.random.default_rng(1)
    whole = [log_rows(f"whole-{i}", random_counts(rng, 40)) for i in range(2)]
    fewer = []
    for i in range(3):
        counts = random_counts(rng, 40)
        del counts["ax"]
        fewer.append(log_rows(f"fewer-{i}", counts))
    land(warehouse, "one", *whole, *fewer)
    update_grams(warehouse)
    cohort = load_cohort(warehouse)
    assert sorted(map(len, cohort.tables)) == [2, 3]
    ids = np.array(cohort.drives["drive_id"].to_pylist())
    part = cohort.part(ids == "fewer-1")
    assert part.drives["drive_id"].to_pylist() == ["fewer-1"]
    (table,) = part.tables
    assert len(table) == 1
    assert "ax" not in table.signals
    assert cohort.part(np.char.startswith(ids, "whole")).tables[0].n.tolist() == [40, 40]
