"""The record of nights."""

from dataclasses import replace
from datetime import date
from pathlib import Path

import duckdb
import pytest

from fleet_slip.errors import StorageError
from fleet_slip.operations.night import Beginning, Nights
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.condition import hash_drive, parse_condition, without_drives

MONDAY, TUESDAY = date(2026, 10, 5), date(2026, 10, 6)
NOW = Beginning("fleet@1", drives=4, rows=100, quarantined=0)


@pytest.fixture
def nights(tmp_path: Path) -> Nights:
    return Nights(LocalFolder(tmp_path), "fleet")


def past(night: date, *faulty: str) -> dict[str, object]:
    return {"night": night.isoformat(), "drives": 4, "faulty": faulty}


def test_a_night_that_is_given_again_has_the_beginning_it_had(nights: Nights) -> None:
    assert nights.begin(MONDAY, NOW) == NOW
    later = Beginning("fleet@2", drives=8, rows=200, quarantined=3)
    assert nights.begin(MONDAY, later) == NOW
    nights.end(past(MONDAY, "cd"))
    assert nights.begin(MONDAY, later) == NOW
    nights.end(past(MONDAY, "ab"))  # as it ended at last
    assert nights.begin(TUESDAY, later) == replace(later, known=frozenset({"ab"}))


def test_models_have_nights_of_their_own(nights: Nights) -> None:
    nights.end(past(MONDAY, "ab"))
    other = Nights(nights.root, "other")
    assert other.begin(TUESDAY, NOW).known == frozenset()


def test_a_changed_record_is_refused(nights: Nights, tmp_path: Path) -> None:
    nights.end(past(MONDAY))
    file = tmp_path / "nights/1.json"
    file.write_text(file.read_text().replace('"drives": 4', '"drives": 5'))
    with pytest.raises(StorageError, match="changed or damaged"):
        nights.begin(TUESDAY, NOW)


def test_drives_are_left_out_by_hashes_that_do_not_name_them() -> None:
    hashes = [hash_drive("fleet", drive) for drive in ("car's <1>", "b")]
    condition = without_drives("mass_kg > 1000 OR true", "fleet", hashes)
    parse_condition(condition)
    assert "car" not in condition
    with duckdb.connect() as database:
        left = database.execute(
            "SELECT drive_id FROM (VALUES ('car''s <1>', 1320), ('b', 1320), ('c', 1320)) "
            f"AS drives(drive_id, mass_kg) WHERE {condition}"
        ).fetchall()
    assert left == [("c",)]
    assert without_drives("true", "fleet", []) == "true"
