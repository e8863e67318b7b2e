"""Folders of logs: what is new comes in, together; what is wrong does not hold up the rest."""

import json
import os
import shutil
import threading
from collections import defaultdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import fleet_slip
from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest import logs
from fleet_slip.ingest.log_files import find_logs
from fleet_slip.ingest.logs import ingest_files, write_batch
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Snapshot
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import run_on
from tests.support.measured import MAPPING_TEXT, a_mapping, csv_text, good_columns
from tests.support.reported import call


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A landing folder of five logs, in folders of their own; the cache is the test's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    (tmp_path / "car.toml").write_text(MAPPING_TEXT)
    for i in range(5):
        write_log(tmp_path / "landing" / f"day {i % 2}" / f"{i}.csv", rows=20 + i)
    (tmp_path / "landing" / "notes.txt").write_text("none of it")
    write_log(tmp_path / "landing" / ".hidden" / "6.csv", rows=26)
    return tmp_path / "landing"


def write_log(file: Path, rows: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(csv_text(good_columns(rows)))


def ingest(folder: Path, *paths: Path) -> list[dict[str, Any]]:
    """Ingest into the root beside a folder; return the reports."""
    root, mapping = folder.parent / "root", folder.parent / "car.toml"
    names = map(str, paths or (folder,))
    printed = call(root, "ingest", *names, "--mapping", str(mapping), "--json")
    return list(json.loads(printed))


def drives(folder: Path) -> dict[str, int]:
    """Rows by drive."""
    warehouse = Warehouse(LocalFolder(folder.parent / "root"))
    counts: dict[str, int] = {}
    for file in warehouse.logs.snapshot().files:
        for name in warehouse.logs.read(file.path, ["drive_id"])["drive_id"].to_pylist():
            counts[name] = counts.get(name, 0) + 1
    return counts


def test_the_logs_of_a_folder_land_together_and_once(folder: Path) -> None:
    reports = ingest(folder)
    assert [report["new"] for report in reports] == [True] * 5
    assert [Path(report["file"]).name for report in reports] == [
        "0.csv", "2.csv", "4.csv", "1.csv", "3.csv",
    ]  # fmt: skip
    assert sorted(drives(folder).values()) == [20, 21, 22, 23, 24]
    snapshot = Warehouse(LocalFolder(folder.parent / "root")).logs.snapshot()
    assert (len(snapshot.files), snapshot.version) == (1, 1)
    assert ingest(folder) == []
    write_log(folder / "new.csv", rows=40)
    assert [Path(report["file"]).name for report in ingest(folder)] == ["new.csv"]
    assert len(drives(folder)) == 6


def test_a_log_is_known_by_its_first_bytes_and_other_files_are_named(folder: Path) -> None:
    parquet = folder / "INCA.dat"
    pq.write_table(pa.table(good_columns(30)), parquet)
    (folder / "car.dbc").write_text("beside the logs")
    (folder / "export.txt").write_text("t,ax\n0,1\n")
    logs = find_logs([folder])
    assert parquet in logs
    assert [file.name for file in logs.passed_over] == ["export.txt", "notes.txt"]
    root, mapping = folder.parent / "root", folder.parent / "car.toml"
    printed = run_on(root, "ingest", folder, "--mapping", mapping)
    assert printed.exit_code == 0
    assert "6 new files" in printed.stderr
    assert "2 files passed over, without the suffix of a log: " in printed.stderr
    assert "notes.txt" in printed.stderr


@pytest.mark.parametrize("target", ["elsewhere", "landing/day 0"])
def test_a_linked_folder_is_an_error_unless_it_is_read_anyway(folder: Path, target: str) -> None:
    write_log(folder.parent / "elsewhere" / "7.csv", rows=27)
    (folder / "disk").symlink_to(folder.parent / target, target_is_directory=True)
    mapping = folder.parent / "car.toml"
    printed = run_on(folder.parent / "root", "ingest", folder, "--mapping", mapping)
    assert len(drives(folder)) == 5
    assert printed.exit_code == (4 if target == "elsewhere" else 0)
    assert ("disk: a symbolic link out of its folder" in printed.stderr) == (target == "elsewhere")


def test_progress_is_in_files(folder: Path) -> None:
    steps: list[tuple[int, int]] = []
    fleet = fleet_slip.open(folder.parent / "root")
    fleet.ingest(folder, a_mapping(), progress=lambda done, total: steps.append((done, total)))
    assert steps == [(number, 5) for number in range(1, 6)]


def test_stored_rows_do_not_depend_on_batches_or_order(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ingest(folder)
    together = drives(folder)
    monkeypatch.setattr(logs, "BATCH_FILES", 2)
    (folder.parent / "root").rename(folder.parent / "first")
    files = sorted(folder.glob("day */*.csv"), key=lambda file: -file.stat().st_size)
    assert len(ingest(folder, *files)) == 5
    assert drives(folder) == together


@pytest.mark.parametrize("content", ["[damaged", "[]", '{"files": {}}', '{"files": 1}'])
def test_without_the_cache_nothing_lands_twice(folder: Path, content: str) -> None:
    ingest(folder)
    (cache,) = (folder.parent / "cache").rglob("*.json")
    cache.write_text(content)
    assert [report["new"] for report in ingest(folder)] == [False] * 5
    assert ingest(folder) == []
    assert len(drives(folder)) == 5


def test_a_root_that_was_restored_from_a_backup_is_asked_for_all(folder: Path) -> None:
    new = folder / "day 2" / "new.csv"
    ingest(folder)
    root, backup = folder.parent / "root", folder.parent / "backup"
    shutil.copytree(root, backup)
    write_log(new, rows=40)
    assert len(ingest(folder)) == 1
    shutil.rmtree(root)
    shutil.copytree(backup, root)
    write_log(folder.parent / "other.csv", rows=50)
    ingest(folder, folder.parent / "other.csv")  # as many commits as before, and others
    assert [report["file"] for report in ingest(folder) if report["new"]] == [str(new)]


def test_a_file_of_another_time_and_the_same_content_is_not_new(folder: Path) -> None:
    ingest(folder)
    os.utime(folder / "day 0" / "0.csv", (1, 1))
    (report,) = ingest(folder)
    assert not report["new"]
    assert ingest(folder) == []


def test_files_that_cannot_be_used_do_not_hold_up_the_rest(folder: Path) -> None:
    (folder / "bad.csv").write_text("t,ax\n0,1\n")
    with pytest.raises(InputError, match=r"bad\.csv: no column 'beta'"):
        ingest(folder)
    assert len(drives(folder)) == 5
    (folder / "empty.csv").write_text("")
    with pytest.raises(InputError, match=r"2 files cannot be used\. "):
        ingest(folder)
    (folder / "bad.csv").unlink()
    write_log(folder / "empty.csv", rows=33)
    assert len(ingest(folder)) == 1


def test_the_same_content_twice_lands_once(folder: Path) -> None:
    write_log(folder / "copy.csv", rows=20)
    assert sorted(report["new"] for report in ingest(folder)) == [False, *[True] * 5]
    assert len(drives(folder)) == 5
    assert ingest(folder) == []


def test_a_batch_of_which_another_process_lands_a_part_is_written_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = Snapshot.commit
    (folder / "bad rows.csv").write_text(csv_text(good_columns(30)) + "oops,1,2\n")

    def meanwhile(self: Snapshot, change: Any) -> None:
        monkeypatch.setattr(Snapshot, "commit", commit)
        assert len(ingest(folder, folder / "day 0" / "2.csv", folder / "bad rows.csv")) == 2
        commit(self, change)

    monkeypatch.setattr(Snapshot, "commit", meanwhile)
    reports = ingest(folder)
    assert sum(report["new"] for report in reports) == 4
    assert sorted(drives(folder).values()) == [20, 21, 22, 23, 24, 30]
    warehouse = Warehouse(LocalFolder(folder.parent / "root"))
    assert warehouse.quarantine.snapshot().rows == 1
    written = {path.name for path in (folder.parent / "root" / "logs").glob("*/*.parquet")}
    assert written == {file.path.rpartition("/")[2] for file in warehouse.logs.snapshot().files}


def test_quarantine_rows_of_a_batch_are_those_of_its_files(folder: Path) -> None:
    for i in (0, 3):
        with (folder / f"day {i % 2}" / f"{i}.csv").open("a") as stream:
            stream.write("oops,1,2\n")
    ingest(folder)
    warehouse = Warehouse(LocalFolder(folder.parent / "root"))
    (file,) = warehouse.quarantine.snapshot().files
    rows = warehouse.quarantine.read(file.path)
    assert sorted(rows["file"].to_pylist()) == ["0.csv", "3.csv"]


def test_a_pattern_stands_for_what_matches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("a/1.csv", "a/2.csv", "b/3.csv", "[odd].csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        columns = good_columns(20 + len(name) + int(name[2]) if name[2].isdigit() else 20)
        (tmp_path / name).write_text(csv_text(columns), encoding="utf-8")
    fleet = fleet_slip.open(tmp_path / "data")
    mapping = a_mapping()
    names = [Path(r.file).name for r in fleet.ingest(str(tmp_path / "*/[12].csv"), mapping)]
    assert names == ["1.csv", "2.csv"]
    names = [Path(r.file).name for r in fleet.ingest(tmp_path / "**/*.csv", mapping)]
    assert names == ["[odd].csv", "3.csv"]
    assert not fleet.ingest(tmp_path / "[odd].csv", mapping)[0].new
    with pytest.raises(InputError, match=r"\*\.mf4: no file matches this pattern"):
        fleet.ingest(tmp_path / "*.mf4", mapping)


def test_threads_read_small_files_and_large_ones_come_alone(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    large, read_by = folder / "large.csv", defaultdict[int, set[str]](set)
    write_log(large, rows=200)

    def write_and_note(warehouse: Warehouse, mapping: Mapping, files: Any, **more: Any) -> Any:
        read_by[threading.get_ident()].update(Path(log.file).name for log in files)
        return write_batch(warehouse, mapping, files, **more)

    monkeypatch.setattr(logs, "write_batch", write_and_note)
    monkeypatch.setattr(logs, "BATCH_FILES", 1)
    monkeypatch.setattr(logs, "BATCH_BYTES", large.stat().st_size)
    reports = ingest(folder)
    assert [report["new"] for report in reports] == [True] * 6
    assert sorted(drives(folder).values()) == [20, 21, 22, 23, 24, 200]
    assert read_by.pop(threading.get_ident()) == {"large.csv"}
    assert set().union(*read_by.values()) == {f"{i}.csv" for i in range(5)}


@pytest.mark.parametrize("inside", ["", "logs", "logs/day=2024-05-31"])
def test_a_data_root_is_no_folder_of_logs(folder: Path, inside: str) -> None:
    ingest(folder)
    with pytest.raises(InputError, match="part of a data root"):
        ingest(folder, folder.parent / "root" / inside)


def test_logs_of_an_object_store_are_to_be_copied_first() -> None:
    with pytest.raises(InputError, match="aws s3 sync"):
        find_logs(["s3://fleet-logs/inbox"])


def test_a_reason_that_several_files_share_is_stated_once(folder: Path) -> None:
    files = sorted(folder.rglob("*.csv"))
    for log in files[:2]:
        log.write_text("t,ay\n0,1\n")
    warehouse = Warehouse(LocalFolder(folder.parent / "root"))
    with pytest.raises(InputError) as caught:
        list(ingest_files(warehouse, files, a_mapping()))
    message = str(caught.value)
    assert message.startswith("2 files cannot be used; all others are stored. ")
    assert f"{quote_name(files[0])}, {quote_name(files[1])}: no column" in message
    assert message.count("no column") == 1
