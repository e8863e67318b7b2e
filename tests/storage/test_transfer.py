"""Objects that come slowly, not as they are stored, or under names that are no paths."""

from pathlib import Path
from typing import Any

import obstore
import pytest
from botocore.session import Session

from fleet_slip.errors import InputError, StorageError
from fleet_slip.ingest import object_inputs
from fleet_slip.ingest.object_inputs import copy_object, find_below, find_object
from fleet_slip.storage import objects
from fleet_slip.storage.objects import ObjectFolder, client
from tests.ingest.test_folders import MAPPING, write_log
from tests.support.commands import run_on
from tests.support.s3_server import ACCESS_KEY, SECRET_KEY, Server, forget_clients

CONTENT = bytes(range(256)) * 1200


@pytest.fixture
def bucket(server: Server) -> str:
    return server.bucket()


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that waits a second for something to come."""
    monkeypatch.setattr(objects, "TIMEOUT_S", 1)
    monkeypatch.setattr(objects, "RETRIES", 0)
    forget_clients()


def amazon(server: Server) -> Any:
    address = server.environment["AWS_ENDPOINT_URL"]
    keys = {"aws_access_key_id": ACCESS_KEY, "aws_secret_access_key": SECRET_KEY}
    return Session().create_client("s3", "us-east-1", endpoint_url=address, **keys)


def test_an_object_may_come_slowly_as_long_as_it_comes(
    bucket: str, server: Server, hasty: None, tmp_path: Path
) -> None:
    obstore.put(client(bucket), "a/log.csv", CONTENT)
    found = find_object(f"{bucket}/a/log.csv")
    assert found is not None
    with server.misbehaving(bytes_per_s=200_000):
        copy_object(found, tmp_path / "log.csv")
        assert ObjectFolder(bucket, "a").read("log.csv") == CONTENT
    assert (tmp_path / "log.csv").read_bytes() == CONTENT


def test_a_store_that_brings_nothing_is_given_up(
    bucket: str, server: Server, hasty: None, tmp_path: Path
) -> None:
    obstore.put(client(bucket), "log.csv", CONTENT)
    found = find_object(f"{bucket}/log.csv")
    assert found is not None
    with (
        server.misbehaving(bytes_per_s=0.2),
        pytest.raises(StorageError, match="does not answer in time"),
    ):
        copy_object(found, tmp_path / "log.csv")


def test_a_flipped_bit_on_the_way_is_seen_and_fetched_again(
    bucket: str, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    obstore.put(client(bucket), "log.csv", CONTENT)
    found = find_object(f"{bucket}/log.csv")
    assert found is not None
    with server.misbehaving(flipping="log.csv"), pytest.raises(InputError, match="in 3 transfers"):
        copy_object(found, tmp_path / "log.csv")
    copy_once, attempts = object_inputs._copy_once, list[str]()

    def flipped_first(*given: Any) -> str:
        with server.misbehaving(flipping="(?!)" if attempts else "log.csv"):
            attempts.append(copy_once(*given))
        return attempts[-1]

    monkeypatch.setattr(object_inputs, "_copy_once", flipped_first)
    copy_object(found, tmp_path / "log.csv")
    assert (tmp_path / "log.csv").read_bytes() == CONTENT
    assert len(attempts) == 2


def test_a_tag_that_is_no_checksum_costs_a_second_transfer(
    bucket: str, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    obstore.put(client(bucket), "log.csv", CONTENT)
    found = ObjectFolder.found
    monkeypatch.setattr(
        ObjectFolder,
        "found",
        lambda self, meta: found(self, {**meta, "e_tag": '"00112233445566778899aabbccddeeff"'}),
    )
    (one,) = find_below(f"{bucket}/")
    with server.misbehaving() as faults:
        copy_object(one, tmp_path / "log.csv")
    assert len([get for get in faults.seen if "log.csv" in get]) == 2
    assert (tmp_path / "log.csv").read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("name", "exit_code", "told", "drives"),
    [
        *((f"day/a{one}b.csv", 6, "Rename it", "0") for one in "\t\x1b\r"),
        (f"day/{'x' * 256}.csv", 4, "invalid file name", "2"),
    ],
)
def test_a_name_that_is_no_path_is_said(
    name: str,
    exit_code: int,
    told: str,
    drives: str,
    bucket: str,
    server: Server,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "car.toml").write_text(MAPPING.format(day="2024-05-31"))
    for number in range(2):
        write_log(tmp_path / f"{number}.csv", 20 + number)
        obstore.put(client(bucket), f"day/{number}.csv", (tmp_path / f"{number}.csv").read_bytes())
    amazon(server).put_object(Bucket=bucket[5:], Key=name, Body=b"x")
    arguments = ("ingest", f"{bucket}/day", "--mapping", str(tmp_path / "car.toml"))
    done = run_on(tmp_path / "root", *arguments)
    assert done.exit_code == exit_code, done.stderr
    assert told in done.stderr
    if drives != "0":
        asked = run_on(tmp_path / "root", "sql", "--csv", "SELECT count(*) AS n FROM drives")
        assert asked.stdout.split() == ['"n"', drives]


def test_an_object_that_is_gone_is_a_fault_of_its_own(bucket: str, tmp_path: Path) -> None:
    obstore.put(client(bucket), "log.csv", CONTENT)
    found = find_object(f"{bucket}/log.csv")
    assert found is not None
    obstore.delete(client(bucket), "log.csv")
    with pytest.raises(InputError, match="no such object"):
        copy_object(found, tmp_path / "log.csv")
