"""A flipped bit is told or makes no difference: nothing is computed from damaged bytes."""

import contextlib
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet_slip.errors import FleetSlipError, StorageError
from fleet_slip.grams.cohort import Folding, load_cohort
from fleet_slip.grams.compute import aggregate
from fleet_slip.grams.update import update_grams
from fleet_slip.models.registry import Registry
from fleet_slip.models.score import score
from fleet_slip.operations.verify import verify
from fleet_slip.storage import data_files, objects
from fleet_slip.storage.data_files import check_local_files, checksum_in
from fleet_slip.storage.folder import Folder
from fleet_slip.views import connect
from fleet_slip.warehouse.database import reading_files
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG
from tests.support.champions import publish_from, write
from tests.support.commands import RunCommand
from tests.support.logs import land, log_rows, path_of, random_counts
from tests.support.s3_server import Server, forget_clients

pytestmark = pytest.mark.long

FLIPS = 30

Answer = Callable[[Warehouse], Any]


def sums(warehouse: Warehouse) -> Any:
    cohort = load_cohort(warehouse, folding=Folding(count=2))
    return cohort.folds("drive", 2).tables, cohort.drive_count


def new_gram_rows(warehouse: Warehouse) -> Any:
    return aggregate(warehouse, warehouse.logs.snapshot().files).to_pylist()


def all_rows(warehouse: Warehouse) -> Any:
    return [
        table.read(file.path).to_pylist()
        for table in (warehouse.logs, warehouse.grams)
        for file in table.snapshot().files
    ]


def queried(warehouse: Warehouse) -> Any:
    with connect(warehouse.root) as database, reading_files(database, "the query"):
        statement = "SELECT drive_id, sum(ay_mps2), max(vx_mps) FROM log GROUP BY 1 ORDER BY 1"
        return database.execute(statement).fetchall()


@pytest.fixture
def filled(warehouse: Warehouse) -> Warehouse:
    """Three log files and their Gram rows."""
    rng = np.random.default_rng(0)
    for name in "abc":
        drives = (log_rows(f"{name}{i}", random_counts(rng, 40)) for i in range(3))
        land(warehouse, name, *drives)
    update_grams(warehouse)
    return warehouse


@contextmanager
def flipped(file: Path, bit: int) -> Iterator[None]:
    """Flip a bit of a file for a while, its time of writing as it was: a disk tells nobody."""
    sound, status = file.read_bytes(), file.stat()
    content = bytearray(sound)
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)
    yield
    file.write_bytes(sound)
    assert file.stat().st_size == status.st_size


LOGS, GRAMS = "logs/day=*/*", "grams/*.parquet"


@pytest.mark.parametrize(
    ("answer", "pattern"),
    [(sums, GRAMS), (new_gram_rows, LOGS), (all_rows, LOGS), (all_rows, GRAMS), (queried, LOGS)],
)
def test_a_flipped_bit_is_told_or_makes_no_difference(
    filled: Warehouse, answer: Answer, pattern: str
) -> None:
    rng = random.Random(0)  # noqa: S311
    files = sorted(path_of(filled.root).glob(pattern))
    usual = answer(filled)
    detected = 0
    for _ in range(FLIPS):
        file = rng.choice(files)
        bit = rng.randrange(file.stat().st_size * 8)
        with flipped(file, bit):
            try:
                assert answer(filled) == usual, (file, bit)
            except FleetSlipError:
                detected += 1
    assert answer(filled) == usual
    assert detected


def test_a_file_is_read_once_while_it_stays_the_same(
    filled: Warehouse, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = filled.logs.snapshot().paths
    assert all(checksum_in(path) for path in paths)
    check_local_files(paths)
    monkeypatch.setattr(data_files, "_require", lambda *_: pytest.fail("read again"))
    check_local_files(paths)


def test_queries_of_people_are_looked_at_too(filled: Warehouse, run_command: RunCommand) -> None:
    file = Path(filled.logs.snapshot().paths[1])
    good = run_command("sql", "SELECT sum(ay) FROM log_counts", "--json")
    assert good.exit_code == 0
    with flipped(file, file.stat().st_size * 4):
        for output in ([], ["--json"], ["--csv"]):
            bad = run_command("sql", "SELECT sum(ay) FROM log_counts", *output)
            assert bad.exit_code == 6
            assert "do not match the checksum in its name" in bad.stderr
        # Files that are not opened need not be looked at.
        assert run_command("sql", "SELECT count(*) FROM grams").exit_code == 0


def query(warehouse: Warehouse, statement: str) -> Any:
    """Ask as `fleet-slip sql` does."""
    with connect(warehouse.root, query=statement) as database:
        return database.sql(statement).fetchall()


QUESTIONS: dict[str, Callable[[Warehouse], Any]] = {
    "load_cohort": lambda w: load_cohort(w).tables[0].products.sum(),
    "fold sums": lambda w: load_cohort(w, folding=Folding()).rows,
    "publish": lambda w: publish_from(w, force=True).version.version,
    "score": lambda w: score(w, Registry(w.root, CATALOG).resolve("beta").manifest, "true"),
    "sql": lambda w: query(w, "SELECT sum(ay) FROM log_counts"),
}


@pytest.fixture
def stored(root: Folder) -> Warehouse:
    """Sixteen drives on the server, reduced, and a model of them."""
    warehouse = Warehouse(root)
    write(warehouse, "good", 16)
    publish_from(warehouse)
    return warehouse


@contextlib.contextmanager
def flipping(server: Server, path: str, share: float = 1.0) -> Iterator[None]:
    """Let answers have flipped bits, and this process remember none of before."""
    objects._fetched.clear()
    forget_clients()
    with server.misbehaving(flipping=path, flipped=share):
        yield
    objects._fetched.clear()


def ask_all(warehouse: Warehouse) -> tuple[dict[str, Any], int]:
    """Return the answers by question, and how many were refused for what is damaged."""
    answers, refused = {}, 0
    for name, ask in QUESTIONS.items():
        objects._fetched.clear()
        try:
            answers[name] = ask(warehouse)
        except StorageError:
            refused += 1
    return answers, refused


@pytest.mark.parametrize("path", ["/grams/[^_]", "/logs/day=", "/models/"])
def test_an_answer_with_a_flipped_bit_is_no_answer(
    server: Server, stored: Warehouse, path: str
) -> None:
    usual, none = ask_all(stored)
    assert none == 0
    with flipping(server, path):
        answers, refused = ask_all(stored)
    assert refused
    assert answers == {name: usual[name] for name in answers}  # these did not look there
    assert ask_all(stored) == (usual, 0)


def test_gram_rows_are_not_made_of_flipped_logs(server: Server, stored: Warehouse) -> None:
    with flipping(server, "/logs/day="), pytest.raises(StorageError, match="do not match"):
        update_grams(stored, feature_set="motion")
    assert load_cohort(stored).drive_count == 16
    assert not verify(stored).damage


def test_single_flipped_answers_among_many_change_nothing(
    server: Server, stored: Warehouse
) -> None:
    usual, _ = ask_all(stored)
    refusals = 0
    for _ in range(4):
        with flipping(server, "/(grams/[^_]|logs/day=|models/)", 0.2):
            answers, refused = ask_all(stored)
        refusals += refused
        assert answers == {name: usual[name] for name in answers}
    assert refusals
