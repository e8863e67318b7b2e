"""A folder of an object store keeps the promises of a local one, whatever the network does."""

import socket
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import obstore
import pytest
from obstore.exceptions import GenericError, NotFoundError

import fleet_slip
from fleet_slip.errors import QuestionError, StorageError
from fleet_slip.grams.update import update_grams
from fleet_slip.storage import objects
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder, object_errors, store_error
from fleet_slip.storage.local import LocalFolder, data_root
from fleet_slip.storage.objects import ObjectFolder, client
from fleet_slip.storage.table import AppTransaction, Change, retry_conflicts
from fleet_slip.warehouse.database import database_errors
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.logs import DAY, ask, land, log_rows, random_counts
from tests.support.s3_server import ACCESS_KEY, SECRET_KEY, Server, forget_clients


def rows(drive: str, count: int = 20) -> object:
    return log_rows(drive, random_counts(np.random.default_rng(0), count))


def test_files_are_put_read_listed_and_removed(root: Folder) -> None:
    assert not root.exists()
    assert (root.names(), root.files()) == ([], [])
    folder = root / "models" / "m"
    folder.put("versions/1.json", b"one")
    data_root(f"{root}-2").put("other", b"not below data")
    assert (root.names(), folder.names()) == (["models"], ["versions"])
    assert folder.read("versions/1.json") == b"one"
    (file,) = root.files()
    assert (file.path, file.size_bytes, file.age_hours < 1) == ("models/m/versions/1.json", 3, True)
    folder.put("versions/1.json", b"two")
    assert not root.remove(file)
    (file,) = root.files()
    assert root.remove(file)
    assert not root.remove(file)
    assert not root.exists()


def test_a_file_is_known_again_where_listings_tell_its_state_otherwise(
    root: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    root.put("one", b"1")
    (file,) = root.files()
    head = obstore.head

    def as_others_do(store: Any, key: str) -> Any:
        meta = head(store, key)
        moment = meta["last_modified"] + timedelta(milliseconds=500)
        return {**meta, "last_modified": moment, "e_tag": f'"{file.identity}"'}

    monkeypatch.setattr(obstore, "head", as_others_do)
    assert root.remove(file)


def test_one_of_many_creators_of_a_file_succeeds(root: Folder) -> None:
    with ThreadPoolExecutor(8) as executor:
        results = list(
            executor.map(
                lambda n: (n % 5, root.create(f"{n % 5}.json", str(n).encode())), range(40)
            )
        )
    assert Counter(name for name, won in results if won) == Counter(range(5))


def test_no_document_is_lost_or_doubled_where_answers_are_lost(
    root: Folder, server: Server
) -> None:
    folder = DocumentFolder(root, "evaluations")

    def write(writer: int) -> list[int]:
        return [folder.append({"writer": writer, "n": n}).number for n in range(8)]

    with server.misbehaving(failing=0.2, slow_s=0.01), ThreadPoolExecutor(3) as executor:
        taken = [number for numbers in executor.map(write, range(3)) for number in numbers]
    assert sorted(taken) == folder.numbers() == list(range(1, 25))
    counts = Counter((d.content["writer"], d.content["n"]) for d in map(folder.read, taken))
    assert counts == Counter((writer, n) for writer in range(3) for n in range(8))


def test_units_land_once_where_answers_are_lost(root: Folder, server: Server) -> None:
    logs = Warehouse(root).logs

    def bring(number: int) -> None:
        action = logs.write_file(f"f{number}", rows(f"d{number}"), DAY)

        def attempt() -> None:
            snapshot = logs.snapshot()
            if snapshot.transaction_version(f"transaction-{number}") is None:
                snapshot.commit(
                    Change(add=[action], transactions=[AppTransaction(f"transaction-{number}", 1)])
                )

        retry_conflicts(attempt)

    with server.misbehaving(failing=0.1), ThreadPoolExecutor(3) as executor:
        list(executor.map(bring, [n // 2 for n in range(8)]))  # each is brought twice
    assert logs.snapshot().rows == 4 * 20
    counts = ask(root, "SELECT drive_id, count(*) FROM log GROUP BY 1")
    assert sorted(counts) == [(f"d{n}", 20) for n in range(4)]


def test_a_name_of_a_data_file_is_used_once(root: Folder) -> None:
    logs = Warehouse(root).logs
    first, second = (logs.write_file("one", rows("a"), DAY) for _ in range(2))
    assert first.path != second.path
    assert first.path[-40:] == second.path[-40:]  # the checksum
    logs.snapshot().commit(Change(add=[second]))
    assert [file.path for file in logs.snapshot().files] == [second.path]
    assert logs.folder.read(first.path) == logs.folder.read(second.path)


def test_a_locked_connection_reads_the_snapshot_and_nothing_else(root: Folder) -> None:
    warehouse = Warehouse(root)
    land(warehouse, "one", rows("a"))
    update_grams(warehouse)
    root.put("other.csv", b"a,b\n1,2\n")
    with fleet_slip.connect(str(root), query="log") as database:
        assert database.execute("SELECT count(*) FROM log").fetchone() == (20,)
        for query in (
            f"FROM read_csv('{root}/other.csv')",
            f"FROM glob('{root}/*')",
            f"COPY (SELECT 1) TO '{root}/new.csv'",
            "FROM read_csv('/etc/passwd')",
        ):
            with pytest.raises(duckdb.PermissionException):
                database.execute(query).fetchall()
    assert "new.csv" not in root.names()


def test_a_file_or_a_column_that_is_not_there_is_named(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    land(warehouse, "one", rows("a"))
    with fleet_slip.open(tmp_path).session() as session:
        with pytest.raises(QuestionError, match="disabled by configuration"):
            session.table("FROM read_parquet('/etc/passwd')")
        [file] = warehouse.logs.snapshot().files
        with pytest.raises(StorageError, match="no column roll"):
            warehouse.logs.read(file.path, ["tick", "roll"])
        warehouse.logs.folder.delete(file.path)
        with pytest.raises(StorageError, match=r"is gone\. If forget --now or compact deleted it"):
            session.table("SELECT sum(ay_mps2) FROM log")
        with pytest.raises(StorageError, match="is gone"), database_errors("the query"):
            session.database.execute("SELECT sum(ay_mps2) FROM log").fetchall()


@pytest.mark.parametrize(
    "url",
    [
        f"s3://{ACCESS_KEY}:{SECRET_KEY}@bucket/data",
        f"s3://bucket/data?secret={SECRET_KEY}",
        "s3://Bucket/data",
        "s3://bucket/../data",
        "s3://bucket/a b",
        "http://bucket/data",
        "file:///data",
    ],
)
def test_a_url_that_is_none_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(StorageError, match="is written as") as caught:
        data_root(url)
    assert SECRET_KEY not in str(caught.value)


def test_urls_of_other_stores_are_data_roots() -> None:
    assert str(data_root("gs://bucket")) == "gs://bucket"
    assert str(data_root("az://container/some/path/")) == "az://container/some/path"


@pytest.fixture
def silent() -> Iterator[socket.socket]:
    """A port on which nobody listens, and that nobody else can take."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        yield bound


Fault = Callable[[Server, pytest.MonkeyPatch, socket.socket], None]


def refuse_writes(server: Server, _patch: pytest.MonkeyPatch, _silent: socket.socket) -> None:
    server.faults.refuse = ("PUT",)


def fail_always(server: Server, _patch: pytest.MonkeyPatch, _silent: socket.socket) -> None:
    server.faults.failing = 1.0


def use_another_key(_server: Server, patch: pytest.MonkeyPatch, _silent: socket.socket) -> None:
    patch.setenv("AWS_ACCESS_KEY_ID", "AKIDOFSOMEBODY")


def use_no_encryption(_server: Server, patch: pytest.MonkeyPatch, _silent: socket.socket) -> None:
    patch.delenv("AWS_ALLOW_HTTP")


def close_the_port(_server: Server, patch: pytest.MonkeyPatch, silent: socket.socket) -> None:
    patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")


def never_answer(server: Server, patch: pytest.MonkeyPatch, silent: socket.socket) -> None:
    silent.listen()
    patch.setattr(objects, "TIMEOUT_S", 1)
    close_the_port(server, patch, silent)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (refuse_writes, "the credentials do not permit this"),
        (fail_always, "the store answers with errors"),
        (use_another_key, "the store refuses the credentials"),
        (use_no_encryption, "export AWS_ALLOW_HTTP=true"),
        (close_the_port, "the store cannot be reached"),
        (never_answer, "does not answer in time"),
    ],
)
def test_a_fault_is_told_in_one_line_without_credentials(
    root: Folder,
    server: Server,
    monkeypatch: pytest.MonkeyPatch,
    silent: socket.socket,
    fault: Fault,
    message: str,
) -> None:
    monkeypatch.setattr(objects, "RETRY_S", 2)
    logs = Warehouse(root).logs
    action = logs.write_file("one", rows("a"), DAY)
    with server.misbehaving():
        objects.client.cache_clear()
        fault(server, monkeypatch, silent)
        attempts: tuple[Callable[[], None], ...] = (
            lambda: root.put("runs/1", b"x"),
            lambda: Warehouse(root).logs.snapshot().commit(Change(add=[action])),
        )
        for attempt in attempts:
            with pytest.raises(StorageError, match=message) as error:
                attempt()
            assert "\n" not in str(error.value)
            assert not {ACCESS_KEY, SECRET_KEY} & set(str(error.value).split())


def test_a_bucket_that_is_not_there_is_told() -> None:
    root = data_root("s3://no-such-bucket/data")
    for attempt in (root.exists, root.files, Warehouse(root).logs.snapshot):
        with pytest.raises(StorageError, match="there is no such bucket"):
            attempt()


def test_a_missing_object_is_told_by_a_query(root: Folder) -> None:
    warehouse = Warehouse(root)
    land(warehouse, "one", rows("a"))
    (file,) = warehouse.logs.folder.files()[-1:]
    assert warehouse.logs.folder.remove(file)
    with pytest.raises(StorageError, match="there is no such object") as caught:
        update_grams(warehouse)
    assert "Traceback" not in str(caught.value)


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


def test_an_object_may_come_slowly_as_long_as_it_comes(
    bucket: str, server: Server, hasty: None
) -> None:
    obstore.put(client(bucket), "a/log.csv", CONTENT)
    with server.misbehaving(bytes_per_s=200_000):
        assert ObjectFolder(bucket, "a").read("log.csv") == CONTENT


def test_a_store_that_brings_nothing_is_given_up(bucket: str, server: Server, hasty: None) -> None:
    obstore.put(client(bucket), "log.csv", CONTENT)
    with (
        server.misbehaving(bytes_per_s=0.2),
        pytest.raises(StorageError, match="does not answer in time"),
    ):
        ObjectFolder(bucket, "").read("log.csv")


SECRET = "AKIDSECRETOFSOMEBODY"  # noqa: S105 - made up

ANSWERS = {
    "there are no credentials": [
        "PUT http://169.254.169.254/latest/api/token",
        "no providers in chain",
    ],
    "there is no such bucket": ["<Code>NoSuchBucket</Code>", "404 Not Found: ContainerNotFound"],
    "the store refuses the credentials": [
        f"Client error with status 403 Forbidden: InvalidAccessKeyId {SECRET}",
        "server returned 401 Unauthorized",
    ],
    "the credentials do not permit this": [
        f"403 Forbidden: <Code>AccessDenied</Code><AWSAccessKeyId>{SECRET}</AWSAccessKeyId>"
    ],
    "the endpoint is http": ["builder error: URL scheme is not allowed"],
    "does not know conditional writes": ["501 Not Implemented: If-None-Match"],
    "answers with errors": ["503 Service Unavailable: SlowDown", "429 Too Many Requests"],
    "does not answer in time": ["HTTP error: request or response TimedOut"],
    "cannot be reached": ["tcp connect error: Connection refused (os error 111)"],
    "there is no such object": ["NoSuchKey", "Object at location x not found: y"],
}


@pytest.mark.parametrize("meaning", ANSWERS)
def test_an_answer_is_told_by_its_most_telling_part(meaning: str) -> None:
    """Several patterns may fit: a bucket that is not there is also 404, a wrong key 403."""
    for answer in ANSWERS[meaning]:
        text = store_error(OSError(answer))
        assert meaning in text and "\n" not in text and SECRET not in text


@pytest.mark.parametrize("answer", ["", "a surprise", "4500 bytes", "port 5000", "1429 rows"])
def test_an_unknown_answer_is_not_interpreted(answer: str) -> None:
    assert store_error(OSError(answer)).startswith("the store cannot be used (OSError)")


@pytest.mark.parametrize("kind", [GenericError, NotFoundError, OSError, ValueError])
def test_failures_of_a_store_become_ours_with_the_place_and_without_the_answer(
    kind: type[Exception],
) -> None:
    with (
        pytest.raises(StorageError, match=r"^s3://bucket/data: the store refuses the") as caught,
        object_errors("s3://bucket/data"),
    ):
        raise kind(f"<Error><Code>InvalidAccessKeyId</Code>{SECRET}</Error>")
    assert SECRET not in str(caught.value)
    assert caught.value.__cause__ is None
    assert caught.value.__suppress_context__
