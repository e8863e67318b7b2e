"""Labels that are wrong alike on one day: the other drives tell, whatever the day's own say."""

import math
import shutil
from collections.abc import Callable
from datetime import date, timedelta
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.job import update_grams
from fleet_slip.operations.quality import examine_drives, find_wrong_labels
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
from tests.support.cars import Signals, broken, counts, drive
from tests.support.logs import DAY, land, log_rows

CARS, DAYS = 12, 3
NIGHT = DAY + timedelta(days=DAYS - 1)


def land_days(warehouse: Warehouse, change: Callable[[Signals], None], every: int = 1) -> None:
    """Land three days of drives of as many cars; on the last, labels of every n-th are wrong."""
    folder, last = two_days()
    shutil.copytree(folder.name, str(warehouse.root))
    changed = [s if car % every else broken(s, change) for car, s in enumerate(last)]
    land_day(warehouse, NIGHT, changed)


@cache
def two_days() -> tuple[TemporaryDirectory[str], list[Signals]]:
    """A data root with the first days, and the drives of the last."""
    rng = np.random.default_rng(1)
    factors = 1 + 0.1 * rng.standard_normal(CARS)
    folder = TemporaryDirectory()
    warehouse = Warehouse(LocalFolder(Path(folder.name)))
    for number in range(DAYS):
        drives = [drive(rng, gentleness=2) for _ in factors]
        for signals, factor in zip(drives, factors, strict=True):
            signals["sideslip"] *= factor
        if number < DAYS - 1:
            land_day(warehouse, DAY + timedelta(days=number), drives)
    return folder, drives


def land_day(warehouse: Warehouse, day: date, drives: list[Signals]) -> None:
    rows = [
        log_rows(f"{day}-{car:02d}", counts(one), day, vehicle_id=f"car-{car}", source="measured")
        for car, one in enumerate(drives)
    ]
    land(warehouse, str(day), *rows, day=day)
    update_grams(warehouse)


def multiplied(factor: float) -> Callable[[Signals], None]:
    return lambda signals: signals.update(sideslip=factor * signals["sideslip"])


def shifted(degrees: float) -> Callable[[Signals], None]:
    return lambda signals: signals.update(sideslip=signals["sideslip"] + math.radians(degrees))


def iced(signals: Signals) -> None:
    """A tenth more, and as much less zero as ice brings: nothing is wrong."""
    multiplied(1.12)(signals)
    shifted(0.1)(signals)


def found(warehouse: Warehouse) -> tuple[set[str], set[date], int]:
    findings = examine_drives(warehouse).findings
    return {one.fault.kind for one in findings}, {one.day for one in findings}, len(findings)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (multiplied(2), "scaled"),
        (multiplied(1.6), "scaled"),
        (multiplied(1 / 57.3), "scaled"),
        (multiplied(-1), "reversed"),
        (shifted(1), "biased"),
    ],
)
def test_a_day_on_which_all_labels_are_wrong_is_found(
    warehouse: Warehouse, change: Callable[[Signals], None], kind: str
) -> None:
    land_days(warehouse, change)
    assert found(warehouse) == ({kind}, {NIGHT}, CARS)


@pytest.mark.parametrize("change", [multiplied(3), multiplied(1 / 57.3), shifted(2)])
def test_a_third_of_a_days_labels_is_found(
    warehouse: Warehouse, change: Callable[[Signals], None]
) -> None:
    land_days(warehouse, change, every=3)
    assert found(warehouse)[1:] == ({NIGHT}, CARS / 3)


def test_what_roads_and_loads_change_is_no_fault(warehouse: Warehouse) -> None:
    land_days(warehouse, iced)
    assert find_wrong_labels(load_cohort(warehouse)) == {}
