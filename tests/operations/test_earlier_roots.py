"""Data roots that earlier releases made are migrated, read, and worked on.

`tests/evidence/roots/` has one of each; its README says how they were made.
"""

import tarfile
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from tests.support.counted_rows import gram_of, row_of, write_counted

ROOTS = sorted((Path(__file__).parents[1] / "evidence/roots").glob("*.tar.gz"))
LARGEST_BYTES = 100_000
DRIVES, ROWS = 4, 1739


@pytest.fixture(params=ROOTS, ids=lambda file: file.name.removesuffix(".tar.gz"))
def fleet(request: pytest.FixtureRequest, tmp_path: Path) -> Fleet:
    with tarfile.open(request.param) as archive:
        archive.extractall(tmp_path, filter="data")
    return fleet_slip.open(tmp_path / "data")


def test_there_are_some_and_they_are_small() -> None:
    assert ROOTS
    assert all(file.stat().st_size < LARGEST_BYTES for file in ROOTS)


def test_a_root_is_migrated_read_and_sound(fleet: Fleet) -> None:
    fleet.migrate()
    assert not fleet.migrate().changed
    fleet.gram()
    assert fleet.check().drives == DRIVES
    (rows,) = fleet.sql("SELECT count(*) FROM log").fetchall()
    assert rows == (ROWS,)
    assert not fleet.verify(full=True).damage
    assert not fleet.quality().findings


def test_its_model_estimates_and_is_trained_again_to_the_same(fleet: Fleet) -> None:
    fleet.migrate()
    fleet.gram()
    old = fleet.model("smoke")
    score = fleet.score(old)
    assert score.rows == ROWS
    assert score.error_std_deg < 0.2
    selection = fleet.cohort().select(model=",".join(old.manifest.signals))
    again = fleet.publish("smoke", selection, force=True).version.manifest
    assert [term.coefficient_exact for term in again.terms] == [
        term.coefficient_exact for term in old.manifest.terms
    ]
    assert again.intercept == old.manifest.intercept


def test_it_takes_gram_rows_of_cars_once_it_is_migrated(fleet: Fleet, tmp_path: Path) -> None:
    fleet.migrate()
    fleet.gram()
    report = fleet.ingest_counted(write_counted(tmp_path / "rows", [row_of(gram_of(1))]))
    assert report.gram_rows == 1
    fleet.forget(vehicle="VIN1")
    assert not fleet.verify(full=True).damage
