"""A corrected mapping replaces, and a recording that is in is told by its bytes and its counts."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import RepeatedError
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.storage.table import Change, Snapshot
from tests.support.measured import SIGNALS, a_mapping, csv_text, recording


def write(file: Path, columns: dict[str, list[str]]) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(csv_text(columns))
    return file


def corrected(**changes: object) -> Mapping:
    turned = {"column": "beta", "unit": "deg", "negate": True}
    return a_mapping(signals={**SIGNALS, "sideslip": turned}, **changes)


@pytest.fixture(scope="module")
def filled_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording and another one, and a root with Gram rows of them."""
    folder = tmp_path_factory.mktemp("made")
    fleet = fleet_slip.open(folder / "data")
    write(folder / "monday.csv", recording())
    fleet.ingest([folder / "monday.csv", write(folder / "b.csv", recording(2))], a_mapping())
    fleet.gram()
    return folder


@pytest.fixture
def fleet(filled_root: Path, tmp_path: Path) -> Fleet:
    """A copy of that."""
    shutil.copytree(filled_root, tmp_path, dirs_exist_ok=True)
    return fleet_slip.open(tmp_path / "data")


def drives(fleet: Fleet) -> dict[str, float]:
    """Mean side-slip angle by file; a file twice would be an error."""
    rows = fleet.sql(
        "SELECT source_file, count(DISTINCT drive_id), avg(sideslip_rad) FROM log GROUP BY ALL"
    ).fetchall()
    assert all(many == 1 for _, many, _ in rows)
    return {file: mean for file, _, mean in rows}


def test_a_corrected_mapping_replaces_what_came_through_the_old_one(
    fleet: Fleet, tmp_path: Path
) -> None:
    before = drives(fleet)
    version = fleet.warehouse.logs.snapshot().version
    with pytest.raises(
        RepeatedError, match=r"monday.csv: this recording is in the logs already.*--replace"
    ):
        fleet.ingest(tmp_path / "monday.csv", corrected())
    assert drives(fleet) == before
    (report,) = fleet.ingest(tmp_path / "monday.csv", corrected(), replace="all")
    assert (report.new, report.drives_replaced) == (True, 1)
    assert fleet.warehouse.logs.snapshot().version == (version or 0) + 1
    after = drives(fleet)
    assert after["monday.csv"] == -before["monday.csv"]
    assert after["b.csv"] == before["b.csv"]
    refused = fleet.sql("SELECT file, count(*) FROM quarantine GROUP BY ALL ORDER BY ALL")
    assert refused.fetchall() == [("b.csv", 1), ("monday.csv", 1)]
    fleet.gram()
    assert fleet.sql("SELECT count(DISTINCT drive_id) FROM grams").fetchall() == [(2,)]
    assert fleet.maintenance.check_grams().drives == 2
    assert not fleet.maintenance.verify(full=True).damage
    (again,) = fleet.ingest(tmp_path / "monday.csv", corrected())
    assert not again.new


def with_more(file: Path) -> Path:
    """Let a file end in an empty line: its bytes are others, its counts are not."""
    file.write_text(f"{file.read_text()}\n")
    return file


@pytest.mark.parametrize(
    "mapping",
    [
        a_mapping(),
        a_mapping(drive={"vehicle_model": "coupe"}),
        a_mapping(name="other", drive={"vehicle_id": "B"}),
    ],
    ids=["another name", "another model", "another car"],
)
def test_a_copy_is_told(mapping: Mapping, fleet: Fleet, tmp_path: Path) -> None:
    before = drives(fleet)
    file = with_more(write(tmp_path / "copy.csv", recording()))
    with pytest.raises(
        RepeatedError, match=r"copy.csv: this recording is in the logs already.*monday.csv"
    ):
        fleet.ingest(file, mapping)
    assert drives(fleet) == before
    (report,) = fleet.ingest(file, mapping, replace="all")
    assert report.drives_replaced == 1
    assert drives(fleet).keys() == {"copy.csv", "b.csv"}


def test_copies_that_come_together_are_told(tmp_path: Path) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    write(tmp_path / "landing" / "a.csv", recording())
    with_more(write(tmp_path / "landing" / "b.csv", recording()))
    write(tmp_path / "landing" / "c.csv", recording(3))
    with pytest.raises(RepeatedError, match=r"b.csv: same recording as .*a.csv"):
        fleet.ingest(tmp_path / "landing", a_mapping())
    assert drives(fleet).keys() == {"a.csv", "c.csv"}


def test_a_file_that_has_changed_replaces_what_it_had(tmp_path: Path) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    file = write(tmp_path / "landing" / "a.csv", recording())
    fleet.ingest(tmp_path / "landing", a_mapping())
    write(file, recording(5))
    with pytest.raises(RepeatedError, match="changed since it was ingested"):
        fleet.ingest(tmp_path / "landing", a_mapping())
    before = drives(fleet)
    (report,) = fleet.ingest(tmp_path / "landing", a_mapping(), replace="all")
    assert report.drives_replaced == 1
    assert drives(fleet) != before


def test_the_night_replaces_what_came_through_a_mapping_that_was_corrected(
    fleet: Fleet, tmp_path: Path
) -> None:
    before = drives(fleet)
    copy = with_more(write(tmp_path / "copy.csv", recording()))
    with pytest.raises(RepeatedError, match=r"copy\.csv"):
        fleet.ingest(copy, a_mapping(), replace="corrected")
    for mapping in (corrected(name="other"), a_mapping(name="other")):
        with pytest.raises(RepeatedError, match="monday"):
            fleet.ingest(tmp_path / "monday.csv", mapping, replace="corrected")
    (report,) = fleet.ingest(tmp_path / "monday.csv", corrected(), replace="corrected")
    assert report.drives_replaced == 1
    assert drives(fleet)["monday.csv"] == -before["monday.csv"]


def test_two_that_land_a_recording_at_once_land_it_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    other = fleet_slip.open(tmp_path / "data")
    first = write(tmp_path / "first.csv", recording())
    second = with_more(write(tmp_path / "second.csv", recording()))
    commit, waiting = Snapshot.commit, [second]

    def commit_later(self: Snapshot, change: Change) -> None:
        if self.table.folder.name == "logs" and waiting:
            other.ingest(waiting.pop(), a_mapping())
        commit(self, change)

    monkeypatch.setattr(Snapshot, "commit", commit_later)
    with pytest.raises(RepeatedError, match=r"first.csv: this recording is in the logs already"):
        fleet.ingest(first, a_mapping())
    assert drives(fleet).keys() == {"second.csv"}


def test_a_replacement_that_stops_at_any_commit_ends_as_if_it_had_not(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = drives(fleet)
    commit = Snapshot.commit
    for stop in (0, 1, 1):  # refused rows, once and for all; Gram rows, then logs
        number = iter(range(99))

        def stopping(
            self: Snapshot, change: Change, number: Iterator[int] = number, stop: int = stop
        ) -> None:
            if next(number) == stop:
                raise KeyboardInterrupt
            commit(self, change)

        with monkeypatch.context() as patch:
            patch.setattr(Snapshot, "commit", stopping)
            with pytest.raises(KeyboardInterrupt):
                fleet.ingest(tmp_path / "monday.csv", corrected(), replace="all")
        assert drives(fleet) == before
    fleet.ingest(tmp_path / "monday.csv", corrected(), replace="all")
    assert drives(fleet)["monday.csv"] == -before["monday.csv"]
    assert fleet.sql("SELECT count(*) FROM quarantine").fetchall() == [(2,)]
    fleet.gram()
    assert fleet.maintenance.check_grams().drives == 2
    assert not fleet.maintenance.verify(full=True).damage
