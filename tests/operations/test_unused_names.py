"""No dictionary of a file names a car, drive or track that is in another file, or was forgotten."""

import io
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_slip.grams.job import update_grams
from fleet_slip.ingest.load import ingest_files
from fleet_slip.operations.forget import forget
from fleet_slip.operations.rewriting import compact, migrate
from fleet_slip.operations.verify import verify
from fleet_slip.storage import encoding
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.forgotten import Audit, Forgettable
from fleet_slip.warehouse.tables import Warehouse
from tests.support.measured import a_mapping, csv_text, good_columns

GONE = ("WVWGONE", "track-gone", "gone.csv", "lap-gone")
"""What names the car in every column: itself, its track, its file, its drive."""
STAYS = ("WVWSTAYS", "track-stays", "stays.csv", "lap-stays")


def recording(names: tuple[str, ...], day: date) -> str:
    columns = good_columns(40)
    columns["ax"] = [*columns["ax"][:-1], "broken"]  # a row for the quarantine
    columns |= {"car": [names[0]] * 40, "track": [names[1]] * 40, "lap": [names[3]] * 40}
    return csv_text(columns | {"day": [day.isoformat()] * 40})


def ingest_two_days(root: Path, folder: Path) -> Warehouse:
    """Two cars on two days, of which one batch makes a file each day, with Gram rows."""
    warehouse = Warehouse(LocalFolder(root))
    files = []
    for day, names in ((1, GONE), (2, STAYS)):
        files.append(folder / names[2])
        files[-1].write_text(recording(names, date(2024, 5, day)))
    columns = {"vehicle_id": "car", "track": "track", "day": "day"}
    drive: dict[str, Any] = {name: {"column": column} for name, column in columns.items()}
    drive["column"] = "lap"
    list(ingest_files(warehouse, files, a_mapping(drive=drive)))
    update_grams(warehouse)
    return warehouse


def texts_below(root: Path) -> Iterator[str]:
    """What stands in each file: its bytes, and decoded its rows with their whole dictionaries."""
    for file in (file for file in root.rglob("*") if file.is_file()):
        yield file.read_bytes().decode("latin-1")
        if file.name.endswith(".parquet") and "_delta_log" not in file.parts:
            schema = pq.read_schema(file)
            names = [name for name in schema.names if not pa.types.is_list(schema.field(name).type)]
            with pq.ParquetFile(io.BytesIO(file.read_bytes()), read_dictionary=names) as parquet:
                for i in range(parquet.num_row_groups):
                    group = parquet.read_row_group(i)
                    parts = [part for column in group.columns for part in column.chunks]
                    yield from (
                        str(part.dictionary.to_pylist())
                        if pa.types.is_dictionary(part.type)
                        else str(part.to_pylist())
                        for part in parts
                    )


def named(root: Path, names: tuple[str, ...]) -> set[str]:
    texts = list(texts_below(root))
    return {name for name in names if any(name in text for text in texts)}


@pytest.fixture
def old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Warehouse:
    """A data root of an earlier version, whose files have the dictionaries of their batch."""
    with monkeypatch.context() as patch:
        patch.setattr(encoding, "_only_used_values", lambda rows: rows)
        return ingest_two_days(tmp_path / "data", tmp_path)


@pytest.mark.parametrize(
    "subject", [Forgettable("vehicle", GONE[0]), Forgettable("before", "2024-05-02")]
)
def test_a_forgotten_car_is_named_nowhere_though_it_landed_beside_another(
    subject: Forgettable, tmp_path: Path
) -> None:
    warehouse = ingest_two_days(tmp_path / "data", tmp_path)
    files = warehouse.logs.snapshot().files
    assert not any(warehouse.logs.has_unused_names(file.path) for file in files)
    assert named(tmp_path / "data", GONE) == set(GONE)
    report = forget(warehouse, subject, now=True)
    assert not report.pending
    assert named(tmp_path / "data", GONE) == set()
    assert named(tmp_path / "data", STAYS) == set(STAYS)
    assert not verify(warehouse, full=True).damage


def test_forgetting_in_a_root_of_an_earlier_version_takes_names_of_other_files_away(
    old: Warehouse, tmp_path: Path
) -> None:
    before = update_grams(old)
    assert not forget(old, Forgettable("vehicle", GONE[0]), now=True).pending
    assert named(tmp_path / "data", GONE) == set()
    assert named(tmp_path / "data", STAYS) == set(STAYS)
    assert not before.rows_read
    assert not update_grams(old).rows_read
    assert not verify(old, full=True).damage


def test_a_car_that_an_earlier_version_forgot_is_found_by_verify_and_taken_away_by_migrate(
    old: Warehouse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("fleet_slip.operations.forget.drop_unused_names", lambda _: 0)
        patch.setattr(Audit, "names_are_exact", False)
        patch.setattr("fleet_slip.storage.table.Table.has_unused_names", lambda *_: False)
        patch.setattr(encoding, "_only_used_values", lambda rows: rows)
        forget(old, Forgettable("vehicle", GONE[0]), now=True)
    assert named(tmp_path / "data", GONE) == set(GONE)
    compact(old)
    assert {f.kind for f in verify(old).damage} == {"name"}
    assert migrate(old).files_without_names == 1
    assert not migrate(old).changed
    assert not verify(old, full=True).damage
    assert forget(old, Forgettable("vehicle", GONE[0]), now=True).old_files_deleted
    assert named(tmp_path / "data", GONE) == set()


@pytest.mark.parametrize("kind", ["vehicle", "drive"])
def test_rows_of_what_was_forgotten_are_found_if_a_copy_brings_them_back(
    kind: str, tmp_path: Path
) -> None:
    warehouse = ingest_two_days(tmp_path / "data", tmp_path)
    column = {"vehicle": "vehicle_id", "drive": "drive_id"}[kind]
    (file, _) = warehouse.logs.snapshot().files
    (name,) = warehouse.logs.read_names(file.path)[column].used
    audit = Audit(warehouse.root)
    audit.begin(Forgettable(kind, name), 1, [], {})  # type: ignore[arg-type]
    assert not verify(warehouse, full=True).damage  # it is being forgotten
    audit.end(Forgettable(kind, name))  # type: ignore[arg-type]
    assert {f.kind for f in verify(warehouse, full=True).damage} == {"name"}
    audit.allow(Forgettable(kind, name))  # type: ignore[arg-type]
    assert not verify(warehouse, full=True).damage
