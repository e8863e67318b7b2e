"""What the Gram job has to do is told without reading what cannot tell it."""

from pathlib import Path

import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.catalogue.features import FeatureCatalogue
from fleet_slip.grams.gram_files import find_backlog, is_of_received, named_files
from fleet_slip.storage.table import Change
from tests.support.counted_rows import START_S, write_counted
from tests.support.fleet_rows import rows_of_fleet


def test_rows_of_cars_are_not_read(tmp_path: Path) -> None:
    """A year of them is 17 GB, and none is of a log."""
    fleet = fleet_slip.open(tmp_path / "data")
    path = tmp_path / "day"
    write_counted(path, rows_of_fleet(3, START_S, seed=1))
    fleet.ingest_counted(path)
    grams = fleet.warehouse.grams.snapshot()
    [file] = grams.files
    assert is_of_received(file)
    Path(str(fleet.warehouse.grams.folder), file.path).write_bytes(b"nobody reads it")
    found = find_backlog(fleet.warehouse.logs.snapshot(), grams)
    assert not found.missing
    assert not found.stale


def test_files_are_told_by_feature_set(tmp_path: Path) -> None:
    warehouse = fleet_slip.open(tmp_path / "data").warehouse
    schema = warehouse.grams.usual_schema
    rows = pa.Table.from_pylist(
        [
            {"feature_set": name, "file": f"{name[0]}-{i % 3}"}
            for name in ("signals", "motion-1")
            for i in range(9)
        ],
        schema=schema,
    )
    action = warehouse.grams.write_file("signals", rows)
    warehouse.grams.snapshot().commit(Change(add=[action]))
    done, named = named_files(warehouse.grams.snapshot(), "motion-1")
    assert done == {"m-0", "m-1", "m-2"}
    assert named == done | {"s-0", "s-1", "s-2"}


def test_no_feature_set_is_called_as_the_rows_of_cars_are() -> None:
    with pytest.raises(ValueError, match="received"):
        FeatureCatalogue.model_validate({"sets": {"received": {}}})
