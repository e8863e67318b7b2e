"""Logs that lie on an object store: what comes in is what would of files of this machine."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import obstore
import pytest

from fleet_slip.errors import InputError
from fleet_slip.ingest.log_files import local_copy
from fleet_slip.ingest.object_inputs import copy_object, find_object
from fleet_slip.storage.objects import client
from tests.ingest.test_folders import MAPPING, write_log
from tests.support.commands import Finished, run_on
from tests.support.dask_processes import dask_processes
from tests.support.s3_server import ServerApart, command_on
from tests.support.state import state

INPUT, STORAGE, REPEATED = 4, 6, 15


@pytest.fixture(scope="module")
def server() -> Iterator[ServerApart]:
    started = ServerApart()
    yield started
    started.stop()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of logs, a mapping, a cache and a temporary folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    (tmp_path / "car.toml").write_text(MAPPING.format(day="2024-05-31"))
    for number in range(4):
        write_log(tmp_path / "landing" / f"day {number % 2}" / f"münchen {number}.csv", 20 + number)
    write_log(tmp_path / "landing" / ".hidden" / "6.csv", rows=26)
    (tmp_path / "landing" / "notes.txt").write_text("none of it")
    return tmp_path


@pytest.fixture
def bucket(server: ServerApart, here: Path) -> str:
    """A bucket with the same logs."""
    url = server.bucket()
    put_all(url, here / "landing")
    return url


def put_all(bucket: str, folder: Path) -> None:
    for file in folder.rglob("*.*"):
        if file.is_file():
            path = str(file.relative_to(folder.parent))
            obstore.put(client(bucket), path, file.read_bytes())


def ingest(root: Path, *arguments: str) -> list[dict[str, Any]]:
    """Ingest through the mapping beside a root; return the reports."""
    mapping = str(root.parent / "car.toml")
    done = command_on(root, "ingest", *arguments, "--mapping", mapping, "--json", apart=True)
    assert done.exit_code == 0, done.stderr
    assert not copies(root.parent)
    return list(json.loads(done.stdout))


def copies(here: Path) -> list[Path]:
    return list((here / "temporary").glob("fleet-slip-copies-*"))


def refused(root: Path, *arguments: str, exit_code: int = INPUT) -> Finished:
    done = run_on(root, "ingest", *arguments, "--mapping", str(root.parent / "car.toml"))
    assert done.exit_code == exit_code, done.stderr
    return done


def fetched(server: ServerApart) -> list[str]:
    """Return what was fetched since this was asked."""
    return [one for one in server.seen() if one.startswith("GET") and ".csv" in one]


def test_a_folder_of_a_store_lands_as_one_of_this_machine_does(
    here: Path, bucket: str, server: ServerApart
) -> None:
    ingest(here / "local", str(here / "landing"))
    reports = ingest(here / "root", f"{bucket}/landing")
    assert [one["file"] for one in reports] == [
        f"{bucket}/landing/day {n % 2}/münchen {n}.csv" for n in (0, 2, 1, 3)
    ]
    assert state(here / "root") == state(here / "local")
    assert len(fetched(server)) >= 4
    assert ingest(here / "root", f"{bucket}/landing/") == []
    assert not fetched(server)
    write_log(here / "landing" / "new.csv", rows=40)
    put_all(bucket, here / "landing")  # all are written anew, with the content that they had
    reports = ingest(here / "root", f"{bucket}/landing")
    assert [one["file"] for one in reports if one["new"]] == [f"{bucket}/landing/new.csv"]


def test_an_object_and_a_pattern_name_logs(here: Path, bucket: str) -> None:
    one = f"{bucket}/landing/day 0/münchen 2.csv"
    assert [found["new"] for found in ingest(here / "root", one)] == [True]
    assert [found["new"] for found in ingest(here / "root", one)] == [False]
    found = ingest(here / "root", f"{bucket}/landing/*/münchen [0-2].csv")
    assert [(Path(one["file"]).name, one["new"]) for one in found] == [
        ("münchen 0.csv", True), ("münchen 2.csv", False), ("münchen 1.csv", True),
    ]  # fmt: skip
    (rest,) = ingest(here / "root", f"{bucket}/**/*.csv")
    assert rest["file"] == f"{bucket}/landing/day 1/münchen 3.csv"
    (hidden,) = ingest(here / "root", f"{bucket}/landing/.hidden/*")
    assert hidden["new"]


def test_an_object_that_changed_since_it_landed_is_refused(here: Path, bucket: str) -> None:
    ingest(here / "root", f"{bucket}/landing")
    write_log(here / "landing" / "day 1" / "münchen 1.csv", rows=50)
    put_all(bucket, here / "landing")
    done = refused(here / "root", f"{bucket}/landing", exit_code=REPEATED)
    assert f"{bucket}/landing/day 1/münchen 1.csv: it has changed since" in done.stderr


def test_an_object_that_changes_while_it_is_read_is_refused(here: Path, bucket: str) -> None:
    found = find_object(f"{bucket}/landing/day 0/münchen 0.csv")
    assert found is not None
    put_all(bucket, here / "landing")
    copy_object(found, here / "same.csv")
    write_log(here / "landing" / "day 0" / "münchen 0.csv", rows=50)
    put_all(bucket, here / "landing")
    with pytest.raises(InputError, match="it changed while it was read"):
        copy_object(found, here / "other.csv")


def test_what_is_wrong_with_an_object_is_said_of_the_object(here: Path, bucket: str) -> None:
    url = f"{bucket}/landing/day 0/münchen 0.csv"
    obstore.put(client(bucket), "landing/day 0/münchen 0.csv", b"t,ay\n0,1\n")
    done = refused(here / "root", f"{bucket}/landing")
    assert f"{url}: " in done.stderr
    assert "temporary" not in done.stderr
    assert not copies(here)
    assert len(ingest(here / "root", f"{bucket}/landing/day 1")) == 0, "the others are in"


@pytest.mark.parametrize(
    ("where", "told"),
    [
        ("landing/none.csv", "no such object"),
        ("landing/*.blf", "no object matches this pattern"),
        ("landing/.hidden", "no such object, and no folder"),
    ],
)
def test_what_is_not_there_is_told(here: Path, bucket: str, where: str, told: str) -> None:
    if where == "landing/.hidden":
        obstore.delete(client(bucket), "landing/.hidden/6.csv")
    assert told in refused(here / "root", f"{bucket}/{where}").stderr


def test_a_url_with_a_password_is_refused_and_not_shown(here: Path) -> None:
    done = refused(here / "root", "s3://key:s3cr3t@bucket/log.csv")
    assert "s3cr3t" not in done.stderr
    assert "s3://BUCKET/PATH" in done.stderr


def test_an_object_is_looked_at_before_it_is_stored(here: Path, bucket: str) -> None:
    url = f"{bucket}/landing/day 1/münchen 3.csv"
    mapping = str(here / "car.toml")
    done = command_on(
        here / "root", "ingest", url, "--mapping", mapping, "--dry-run", "--json", apart=True
    )
    assert done.stdout, done.stderr
    (seen,) = json.loads(done.stdout)
    assert (seen["file"], seen["rows_read"]) == (url, 23)
    done = command_on(here / "root", "mapping", "suggest", url, apart=True)
    assert done.exit_code == 0, done.stderr
    assert f"{url}: " in done.stdout
    assert 'ax = { column = "ax"' in done.stdout
    several = run_on(here / "root", "mapping", "suggest", f"{bucket}/landing")
    assert several.exit_code == 2
    assert "Give one of them" in several.stderr
    assert not copies(here)


@pytest.mark.parametrize("path", ["landing/../../../x.csv", "/x.csv", "a//x.csv", "a/./x.csv"])
def test_no_name_of_an_object_leads_out_of_the_temporary_folder(
    here: Path, bucket: str, path: str
) -> None:
    found = find_object(f"{bucket}/landing/day 0/münchen 0.csv")
    assert found is not None
    with (
        pytest.raises(InputError, match="invalid file name"),
        local_copy(replace(found, path=path)),
    ):
        pass
    assert not list(here.rglob("x.csv"))


@pytest.mark.long
def test_workers_of_a_cluster_fetch_for_themselves(here: Path, bucket: str) -> None:
    ingest(here / "local", str(here / "landing"))
    with dask_processes(here) as dask:
        ingest(here / "root", f"{bucket}/landing", "--cluster", dask.address)
    assert state(here / "root") == state(here / "local")
