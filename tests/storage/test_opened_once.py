"""A table is opened once until somebody commits, and no reader sees less than what is there."""

import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from deltalake import DeltaTable

from fleet_slip.errors import RefusedError
from fleet_slip.storage import table as tables
from fleet_slip.storage.table import SCALE
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, path_of

COUNTS = {"ax": np.arange(5), "sideslip": np.arange(5)}


def test_a_table_is_opened_again_after_a_commit_of_anybody(
    warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch
) -> None:
    land(warehouse, "one", log_rows("one", COUNTS))
    opened: list[str] = []

    def opening(uri: str, **options: Any) -> DeltaTable:
        opened.append(uri)
        return DeltaTable(uri, **options)

    monkeypatch.setattr(tables, "DeltaTable", opening)
    first = warehouse.logs.snapshot()
    assert len(first.files) == 1
    opened.clear()
    again = Warehouse(warehouse.root).logs.snapshot()
    assert (again is first, first.renewed() is first, opened) == (True, True, [])
    delta = DeltaTable(first.table.uri("")[:-1])  # as another process does
    delta.alter.set_table_properties({"by": "another"}, raise_if_not_exists=False)
    newer = warehouse.logs.snapshot()
    assert (newer.version, first.version) == (delta.version(), delta.version() - 1)
    assert first.renewed() is newer
    land(warehouse, "two", log_rows("two", COUNTS))
    assert len(warehouse.logs.snapshot().files) == 2
    assert len(newer.files) == len(first.files) == 1


def test_a_table_in_the_place_of_another_is_opened(warehouse: Warehouse) -> None:
    land(warehouse, "one", log_rows("one", COUNTS))
    assert warehouse.logs.snapshot().rows == 5
    shutil.rmtree(path_of(warehouse.root) / "logs")
    assert warehouse.logs.snapshot().version is None
    land(warehouse, "two", log_rows("two", {name: np.arange(7) for name in COUNTS}))
    assert warehouse.logs.snapshot().rows == 7


def test_counts_in_other_scales_are_refused_of_an_opened_table(warehouse: Warehouse) -> None:
    land(warehouse, "one", log_rows("one", COUNTS))
    logs = warehouse.logs
    assert logs.snapshot().rows == 5
    place = logs.schema.get_field_index("ax")
    finer = logs.schema.field("ax").with_metadata({SCALE: "0.0001"})
    schema: pa.Schema = logs.schema.set(place, finer)
    with pytest.raises(RefusedError, match="other scales"):
        replace(logs, schema=schema).snapshot()
