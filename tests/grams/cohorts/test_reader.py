"""A database of Gram rows is opened once for readers that follow each other."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from fleet_slip.catalogue.features import PLAIN
from fleet_slip.errors import DataError
from fleet_slip.grams import reader
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.job import update_grams
from fleet_slip.grams.reader import GramReader
from fleet_slip.warehouse.condition import parse_condition
from fleet_slip.warehouse.tables import Warehouse, open_tables
from tests.support.logs import land, log_rows, random_counts


def land_another(warehouse: Warehouse, number: int) -> None:
    rng = np.random.default_rng(number)
    land(warehouse, f"f{number}", log_rows(f"d{number}", random_counts(rng, 30)))
    update_grams(warehouse)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """What is opened anew."""
    found: list[object] = []

    def counting(*given: Any) -> Any:
        found.append(given)
        return open_tables(*given)

    monkeypatch.setattr(reader, "open_tables", counting)
    return found


def test_a_reader_takes_over_what_the_last_one_opened_until_somebody_commits(
    warehouse: Warehouse, opened: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(2):
        land_another(warehouse, number)
        assert [len(load_cohort(warehouse).drives) for _ in range(3)] == [number + 1] * 3
        assert len(opened) == number + 1
    monkeypatch.setattr(reader, "USES", 3)
    load_cohort(warehouse)
    load_cohort(warehouse)
    assert len(opened) == 3
    monkeypatch.setattr(reader, "KEPT_BYTES", 0)
    load_cohort(warehouse)
    load_cohort(warehouse)
    assert len(opened) == 4


def test_a_reader_that_failed_leaves_nothing(warehouse: Warehouse, opened: list[object]) -> None:
    land_another(warehouse, 0)
    with pytest.raises(DataError, match="as a query may"), GramReader(warehouse) as failing:
        failing.opened(PLAIN, parse_condition("true"))
        raise DataError("as a query may")
    load_cohort(warehouse)
    assert len(opened) == 2


def test_threads_and_processes_have_their_own(warehouse: Warehouse, opened: list[object]) -> None:
    land_another(warehouse, 0)
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda _: len(load_cohort(warehouse).drives), range(40)))
    assert found == [1] * 40
    load_cohort(warehouse)
    before = len(opened)
    child = os.fork()
    if not child:
        load_cohort(warehouse)
        os._exit(len(opened) - before)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    load_cohort(warehouse)
    assert len(opened) == before
