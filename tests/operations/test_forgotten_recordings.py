"""A forgotten drive stays away under other names, and no dictionary of a file names it."""

import hashlib
import io
import shutil
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_slip.grams.update import update_grams
from fleet_slip.ingest import logs
from fleet_slip.ingest.logs import ingest_files
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured_log import open_measured
from fleet_slip.ingest.recordings import drop_erased_drives, drop_erased_rejects
from fleet_slip.ingest.ticks import MeasuredDrive
from fleet_slip.operations.forget import forget
from fleet_slip.operations.verify import verify
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.erasure_log import FOLDER, ErasureLog, ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.measured import a_mapping, csv_text, good_columns, ingest_file, recording

ROWS = 600


def write(folder: Path, columns: dict[str, Any], name: str = "monday.csv") -> Path:
    file = folder / name
    file.write_text(csv_text(columns))
    return file


@pytest.fixture(scope="module")
def after_it_was_forgotten(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root where the drive of `recording` was forgotten, to copy."""
    tmp_path = tmp_path_factory.mktemp("forgotten")
    warehouse = Warehouse(LocalFolder(tmp_path / "data"))
    ingest_file(warehouse, write(tmp_path, recording()), a_mapping())
    (file,) = warehouse.logs.snapshot().files
    (name,) = warehouse.logs.read_names(file.path)["drive_id"]
    assert forget(warehouse, ErasureSubject("drive", name), now=True).drives == 1
    return tmp_path / "data"


@pytest.fixture
def forgotten(after_it_was_forgotten: Path, tmp_path: Path) -> Warehouse:
    """Such a root of one's own."""
    return Warehouse(LocalFolder(shutil.copytree(after_it_was_forgotten, tmp_path / "data")))


def is_empty(warehouse: Warehouse) -> bool:
    return not warehouse.logs.snapshot().rows and not warehouse.quarantine.snapshot().rows


Copy = tuple[dict[str, Any], Mapping]


AGAIN: dict[str, Callable[[], Copy]] = {
    "another mapping": lambda: (recording(), a_mapping(name="other")),
    "another car": lambda: (recording(), a_mapping(drive={"vehicle_id": "pseudonym"})),
    "another day": lambda: (recording(), a_mapping(drive={"day": "2020-01-01"})),
    "another model": lambda: (recording(), a_mapping(drive={"vehicle_model": "coupe"})),
    "a later clock": lambda: (
        recording() | {"t": [f"{500 + i / 100:.2f}" for i in range(ROWS)]},
        a_mapping(),
    ),
}


@pytest.mark.parametrize("change", AGAIN)
def test_the_recording_does_not_land_again(
    change: str, forgotten: Warehouse, tmp_path: Path
) -> None:
    columns, mapping = AGAIN[change]()
    report = ingest_file(forgotten, write(tmp_path, columns, "tuesday.csv"), mapping)
    assert (report.drives_forgotten, report.counts.drives) == (1, 0)
    assert is_empty(forgotten)


def test_a_car_that_stands_is_known_by_its_name_and_day(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    standing = recording() | {"ax": ["0"] * ROWS, "beta": ["0"] * ROWS}
    ingest_file(warehouse, write(tmp_path, standing), a_mapping())
    (file,) = warehouse.logs.snapshot().files
    (name,) = warehouse.logs.read_names(file.path)["drive_id"]
    forget(warehouse, ErasureSubject("drive", name))
    again = write(tmp_path, standing, "again.csv")
    assert ingest_file(warehouse, again, a_mapping(name="other")).drives_forgotten == 1
    other = a_mapping(drive={"vehicle_id": "other"})
    assert ingest_file(warehouse, again, other).counts.drives == 1


def test_other_recordings_of_the_car_land(forgotten: Warehouse, tmp_path: Path) -> None:
    other = write(tmp_path, recording(2), "other.csv")
    report = ingest_file(forgotten, other, a_mapping())
    assert (report.drives_forgotten, report.counts.drives) == (0, 1)
    again = write(tmp_path, recording(), "again.csv")
    assert ingest_file(forgotten, again, a_mapping(name="b")).drives_forgotten == 1


def test_a_forgotten_car_does_not_come_back_under_another_name(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    file = write(tmp_path, recording())
    ingest_file(warehouse, file, a_mapping())
    car = ErasureSubject("vehicle", "car")
    forget(warehouse, car)
    renamed = a_mapping(drive={"vehicle_id": "renamed"})
    assert ingest_file(warehouse, file, renamed).drives_forgotten == 1
    ErasureLog(warehouse.root).allow(car)
    again = a_mapping(name="again", drive={"vehicle_id": "renamed"})
    assert ingest_file(warehouse, file, again).counts.drives == 1


def test_a_recording_that_is_forgotten_while_it_lands_again_does_not(
    warehouse: Warehouse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ingest_file(warehouse, write(tmp_path, recording()), a_mapping())
    (file,) = warehouse.logs.snapshot().files
    (name,) = warehouse.logs.read_names(file.path)["drive_id"]
    commit = logs.commit_batch

    def overtaken(*batch: Any) -> Any:
        forget(warehouse, ErasureSubject("drive", name), now=True)
        return commit(*batch)

    monkeypatch.setattr(logs, "commit_batch", overtaken)
    again, other = write(tmp_path, recording()), a_mapping(name="other")
    (report,) = logs.ingest_files(warehouse, [again], other, replace="all")
    assert report.drives_forgotten == 1
    assert is_empty(warehouse)


@pytest.mark.parametrize("name", [" Stra\u00dfe 1", "STRASSE 1", "stra\u00dfe 1\u00a0"])
def test_names_are_compared_after_normalization_and_case_folding(
    warehouse: Warehouse, tmp_path: Path, name: str
) -> None:
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}})
    columns = recording() | {"car": ["Stra\u00dfe 1"] * ROWS}
    ingest_file(warehouse, write(tmp_path, columns), mapping)
    other = recording(2) | {"car": [name] * ROWS}
    assert forget(warehouse, ErasureSubject("vehicle", name)).drives == 1
    assert is_empty(warehouse)
    file = write(tmp_path, other, "tuesday.csv")
    assert ingest_file(warehouse, file, mapping).drives_forgotten == 1
    ErasureLog(warehouse.root).allow(ErasureSubject("vehicle", "strasse 1"))
    again = write(tmp_path, recording(3) | {"car": [name] * ROWS}, "wednesday.csv")
    assert ingest_file(warehouse, again, mapping).counts.drives == 1


def test_entries_of_names_as_they_were_typed_bar_that_name_until_it_is_allowed(
    tmp_path: Path,
) -> None:
    erasure_log, key = ErasureLog(LocalFolder(tmp_path / "data")), "00" * 32
    typed = hashlib.blake2b(b"vehicle:CAR", key=bytes(32), digest_size=32).hexdigest()
    for event in ("begun", "done"):
        entry: dict[str, Any] = {"kind": "vehicle", "subject": typed, "key": key, "event": event}
        DocumentFolder(erasure_log.root, FOLDER).append(entry)
    assert erasure_log.erased({"CAR", " CAR", "car"}, ()).vehicles == {"CAR", " CAR"}
    assert erasure_log.state(ErasureSubject("vehicle", "CAR")) == "done"
    erasure_log.begin(ErasureSubject("vehicle", "car"), 1, [])
    erasure_log.end(ErasureSubject("vehicle", "car"))
    assert erasure_log.erased({"CAR", "car"}, ()).vehicles == {"CAR", "car"}
    erasure_log.allow(ErasureSubject("vehicle", "CAR"))
    assert not erasure_log.erased({"CAR", "car"}, ())


GONE = ("WVWGONE", "track-gone", "gone.csv", "lap-gone")
"""Names of the car in every column: its own, its track, its file, its drive."""
STAYS = ("WVWSTAYS", "track-stays", "stays.csv", "lap-stays")


def log_of(names: tuple[str, ...], day: date) -> str:
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
        files[-1].write_text(log_of(names, date(2024, 5, day)))
    columns = {"vehicle_id": "car", "track": "track", "day": "day"}
    drive: dict[str, Any] = {name: {"column": column} for name, column in columns.items()}
    drive["column"] = "lap"
    list(ingest_files(warehouse, files, a_mapping(drive=drive)))
    update_grams(warehouse)
    return warehouse


def texts_below(root: Path) -> Iterator[str]:
    """Return the content of each file: its bytes, and its decoded rows with their dictionaries."""
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


@pytest.mark.parametrize(
    "subject", [ErasureSubject("vehicle", GONE[0]), ErasureSubject("before", "2024-05-02")]
)
def test_a_forgotten_car_is_named_nowhere_though_it_landed_beside_another(
    subject: ErasureSubject, tmp_path: Path
) -> None:
    warehouse = ingest_two_days(tmp_path / "data", tmp_path)
    assert named(tmp_path / "data", GONE) == set(GONE)
    report = forget(warehouse, subject, now=True)
    assert not report.pending
    assert named(tmp_path / "data", GONE) == set()
    assert named(tmp_path / "data", STAYS) == set(STAYS)
    assert not verify(warehouse, full=True).damage


@pytest.mark.parametrize("kind", ["vehicle", "drive"])
def test_rows_of_what_was_forgotten_are_found_if_a_copy_brings_them_back(
    kind: str, tmp_path: Path
) -> None:
    warehouse = ingest_two_days(tmp_path / "data", tmp_path)
    column = {"vehicle": "vehicle_id", "drive": "drive_id"}[kind]
    (file, _) = warehouse.logs.snapshot().files
    (name,) = warehouse.logs.read_names(file.path)[column]
    erasure_log = ErasureLog(warehouse.root)
    erasure_log.begin(ErasureSubject(kind, name), 1, [], {})  # type: ignore[arg-type]
    assert not verify(warehouse, full=True).damage  # it is being forgotten
    erasure_log.end(ErasureSubject(kind, name))  # type: ignore[arg-type]
    assert {f.kind for f in verify(warehouse, full=True).damage} == {"name"}
    erasure_log.allow(ErasureSubject(kind, name))  # type: ignore[arg-type]
    assert not verify(warehouse, full=True).damage


def two_cars(folder: Path) -> tuple[list[MeasuredDrive], pa.Table]:
    """The drives of a log of the cars a and b, one each, and its refused rows: the last of each."""
    columns = {name: values * 2 for name, values in good_columns(20).items()}
    columns["car"] = ["a"] * 20 + ["b"] * 20
    columns["ax"] = list(columns["ax"])
    columns["ax"][19] = columns["ax"][39] = "broken"
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}})
    file = folder / "log.csv"
    file.write_text(csv_text(columns))
    with open_measured(file, mapping) as stream:
        return list(stream.drives()), next(stream.quarantine())


def cars(rows: pa.Table) -> set[str]:
    return set(rows["vehicle_id"].cast(pa.string()).to_pylist())


@pytest.mark.parametrize("kind", ["vehicle", "drive"])
def test_the_rows_of_what_was_forgotten_are_left_out(
    kind: Literal["vehicle", "drive"], tmp_path: Path
) -> None:
    drives, refused = two_cars(tmp_path)
    of_a, of_b = drives
    erasure_log = ErasureLog(LocalFolder(tmp_path / "data"))
    erasure_log.begin(ErasureSubject(kind, "a" if kind == "vehicle" else of_a.drive_id), 1, [], {})
    assert drop_erased_drives(drives, erasure_log) == [of_b]
    assert cars(refused) == {"a", "b"}
    assert cars(drop_erased_rejects(refused, erasure_log)) == {"b"}
