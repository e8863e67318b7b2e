"""Measured files of absurd shape, links and pipes: refused or read, in bounded memory, in place."""

import os
import resource
import stat
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet_slip.base import no_progress
from fleet_slip.config import LONGEST_FILE_BYTES, load_config, read_named_file
from fleet_slip.errors import ConfigError, FleetSlipError, InputError, StorageError
from fleet_slip.grams.update import update_grams
from fleet_slip.ingest.formats.can import parse_database
from fleet_slip.ingest.formats.file_formats import CanBus, read_can_database
from fleet_slip.ingest.formats.reading import StrayLink
from fleet_slip.ingest.log_files import find_logs
from fleet_slip.ingest.logs import ingest_files
from fleet_slip.models.acceptance import PublishThresholds
from fleet_slip.models.registry import Registry
from fleet_slip.resources import Configs
from fleet_slip.storage.local import LocalFolder, data_root
from fleet_slip.storage.runs import recording
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG
from tests.support.commands import RunCommand, within
from tests.support.logs import ask, land, log_rows, path_of, random_counts
from tests.support.manifests import manifest, publish
from tests.support.measured import a_mapping, csv_text, good_columns, ingest_file

MIB = 2**20


def test_a_million_columns_are_refused_in_little_memory(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    file = tmp_path / "wide.csv"
    file.write_text(",".join(["t", "ax", "beta", *(f"c{i}" for i in range(10**6))]) + "\n0,1,2\n")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError):
        ingest_file(warehouse, file, a_mapping())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500 * MIB / 1024
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("target", ["/dev/zero", "folder", "/proc/self/mem", "nowhere"])
def test_links_to_what_is_no_file_are_refused(
    warehouse: Warehouse, tmp_path: Path, target: str
) -> None:
    (tmp_path / "folder" / "below").mkdir(parents=True)
    (tmp_path / "folder" / "below" / "notes.txt").write_text("no log")
    link = tmp_path / "link.csv"
    link.symlink_to(target)
    with pytest.raises(InputError):
        ingest_file(warehouse, link, a_mapping())
    assert not (tmp_path / "data").exists()


def test_a_link_out_of_a_folder_is_refused_and_holds_nothing_up(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    folder, other = tmp_path / "landing", tmp_path / "private"
    folder.mkdir()
    other.mkdir()
    (folder / "a.csv").write_text(csv_text(good_columns()))
    (other / "secret.csv").write_text(csv_text(good_columns(30)))
    for name, target in {
        "b.csv": other / "secret.csv",
        "c.csv": Path("../private/secret.csv"),
        "d.csv": folder / "b.csv",
        "e.csv": Path("/dev/zero"),
        "f.csv": folder / "a.csv",
    }.items():
        (folder / name).symlink_to(target)
    (folder / "below").symlink_to(other)
    reports = []
    with pytest.raises(
        InputError, match=r"5 files cannot be used; all others .*b\.csv, .*d.csv.*: a symbolic link"
    ):
        reports += list(ingest_files(warehouse, find_logs([folder]), a_mapping()))
    assert warehouse.logs.snapshot().rows == 20


def test_a_pattern_does_not_lead_out_of_its_folder(tmp_path: Path) -> None:
    folder, other = tmp_path / "landing", tmp_path / "private"
    (folder / "sound").mkdir(parents=True)
    other.mkdir()
    for file in (folder / "sound" / "a.csv", other / "secret.csv"):
        file.write_text(csv_text(good_columns()))
    (folder / "below").symlink_to(other)
    logs = find_logs([f"{folder}/**/*.csv"])
    strays = {str(file): isinstance(file, StrayLink) for file in logs}
    assert strays == {str(folder / "sound/a.csv"): False, str(folder / "below/secret.csv"): True}
    (tmp_path / "link").symlink_to(folder)  # a person's own link to a folder is followed
    assert not isinstance(find_logs([tmp_path / "link" / "sound"])[0], StrayLink)


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_nobody_gets_more_rights_than_the_umask_gives(tmp_path: Path, umask: int) -> None:
    old = os.umask(umask)
    try:
        warehouse = Warehouse(LocalFolder(tmp_path / "data"))
        land(warehouse, "one", log_rows("d", random_counts(np.random.default_rng(1), 20)))
        update_grams(warehouse, no_progress)
        publish(Registry(warehouse.root, CATALOG), manifest())
    finally:
        os.umask(old)
    files = [*path_of(warehouse.root).rglob("*")]
    assert len(files) > 10
    for file in files:
        assert not stat.S_IMODE(file.stat().st_mode) & umask, file


LINE = "s3cret:x:0:0:root:/root:/bin/bash"


def read_database(file: Path) -> Any:
    return parse_database(read_can_database(CanBus(database=file.name), file.parent))


def test_no_error_quotes_a_file_that_is_not_what_a_config_says(tmp_path: Path) -> None:
    file = tmp_path / "car.dbc"
    for content in (LINE, f"{LINE}\n{LINE}\n", f"\n{LINE}", f'"{LINE}', f"\0{LINE}"):
        file.write_text(content)
        with pytest.raises(FleetSlipError) as caught:
            read_database(file)
        assert file.name in str(caught.value)
        assert "s3cret" not in str(caught.value)


def test_pipes_devices_and_folders_are_refused_at_once(tmp_path: Path) -> None:
    makers: tuple[Callable[[Path], object], ...] = (
        os.mkfifo,
        lambda file: file.symlink_to("/dev/zero"),
        lambda file: file.symlink_to("/dev/tty"),
        Path.mkdir,
        lambda file: file.symlink_to("nowhere"),
        lambda file: file.symlink_to(file.name),
    )
    for number, make in enumerate(makers):
        file = tmp_path / str(number) / "car.dbc"
        file.parent.mkdir()
        make(file)
        with within(), pytest.raises(FleetSlipError, match=r"car\.dbc"):
            read_database(file)


def test_a_file_is_read_up_to_a_size(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"x" * LONGEST_FILE_BYTES)
    assert len(read_named_file(file)) == LONGEST_FILE_BYTES
    with file.open("ab") as stream:
        stream.write(b"x")
    with pytest.raises(ConfigError, match="larger than"):
        read_named_file(file)


@pytest.mark.parametrize("target", ["nowhere", "publish.toml", "/dev/null", "."])
def test_a_config_that_cannot_be_read_is_not_replaced_by_the_shipped_one(
    tmp_path: Path, target: str
) -> None:
    (tmp_path / "publish.toml").symlink_to(target)
    with pytest.raises(ConfigError, match=r"publish\.toml"):
        load_config(Configs(tmp_path).file("publish.toml"), PublishThresholds)


@pytest.mark.parametrize("kind", ["models", "mappings"])
def test_a_folder_of_configs_that_leads_nowhere_does_not_count_as_empty(
    tmp_path: Path, kind: str
) -> None:
    (tmp_path / kind).symlink_to("nowhere")
    with pytest.raises(ConfigError, match=f"{kind}: not a folder that can be read"):
        Configs(tmp_path)


@pytest.mark.timeout(60)
def test_a_sparse_file_is_refused_before_it_is_read(warehouse: Warehouse, tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text("t,ax\n")
    os.truncate(file, 10**11)
    with pytest.raises(InputError, match="100,000,000,000 bytes, but only"):
        ingest_file(warehouse, file, a_mapping())


def test_a_clock_before_1970_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time", lambda: -86400.0)
    with pytest.raises(StorageError, match="before 1970"):
        data_root(tmp_path)


Place = Callable[[Path], Path]


def a_link(file: Path) -> Path:
    """Put a link in a file's place, to a file of somebody else; return that."""
    other = file.with_name("of-somebody")
    other.write_text("precious")
    file.unlink(missing_ok=True)
    file.symlink_to(other)
    return other


def a_pipe(file: Path) -> Path:
    """Put a pipe that nobody writes to in a file's place."""
    file.unlink(missing_ok=True)
    os.mkfifo(file)
    return file


def untouched(other: Path) -> bool:
    return stat.S_ISFIFO(other.stat().st_mode) or other.read_text() == "precious"


@pytest.mark.parametrize("place", [a_link, a_pipe])
def test_a_lock_is_taken_on_a_file_only(
    tmp_path: Path, place: Place, run_command: RunCommand
) -> None:
    (tmp_path / "data").mkdir()
    other = place(tmp_path / "data/.run-smoke.lock")
    done = run_command("run", "--campaign", "smoke", "--days", "1")
    assert done.exit_code == StorageError.exit_code
    assert ".run-smoke.lock: a link, a folder or a pipe" in done.stderr
    assert untouched(other)


@pytest.mark.parametrize("place", [a_link, a_pipe])
def test_the_history_is_written_to_files_only_and_read_from_files_only(
    tmp_path: Path, place: Place
) -> None:
    (tmp_path / "runs").mkdir()
    other = place(tmp_path / f"runs/{datetime.now(UTC):%Y-%m}.jsonl")
    if other.is_file():
        other.write_text('{"run_id":"of-another"}')
    with recording(LocalFolder(tmp_path), "gram", []):
        pass
    assert ask(tmp_path, "SELECT run_id FROM runs") == []
    if other.is_file():
        assert other.read_text() == '{"run_id":"of-another"}'


@pytest.mark.parametrize("place", [a_link, a_pipe])
@pytest.mark.parametrize("file", ["versions/1.json", "history/1.json"])
def test_a_document_is_read_from_a_file_only(
    tmp_path: Path, place: Place, file: str, run_command: RunCommand
) -> None:
    """Even a link to the very document: tomorrow it may lead to another."""
    publish(Registry(LocalFolder(tmp_path / "data"), CATALOG), manifest())
    document = tmp_path / "data/models/sideslip" / file
    content = document.read_text()
    other = place(document)
    if other.is_file():
        other.write_text(content)
    done = run_command("show", "sideslip")
    assert done.exit_code == StorageError.exit_code
    assert "a link, a folder or a pipe" in done.stderr


def test_a_data_file_that_is_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    a_pipe(tmp_path / "file.parquet")
    with pytest.raises(StorageError, match="no such file"):
        LocalFolder(tmp_path).open("file.parquet")


def test_a_pipe_given_to_a_command_is_refused_at_once(
    tmp_path: Path, run_command: RunCommand
) -> None:
    os.mkfifo(tmp_path / "pipe")
    done = run_command("ingest", str(tmp_path / "pipe"))
    assert done.exit_code == InputError.exit_code
    assert "pipe" in done.stderr
