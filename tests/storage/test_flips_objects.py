"""A store whose answers have flipped bits: they are noticed, or the result is the same."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from fleet_slip.errors import StorageError
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.folding import Folding
from fleet_slip.grams.job import update_grams
from fleet_slip.models.registry import Registry
from fleet_slip.models.score import score
from fleet_slip.operations.verify import verify
from fleet_slip.storage import objects
from fleet_slip.storage.folder import Folder
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse
from tests.models.acceptance.test_champion_rules import publish_from, write
from tests.support.s3_server import Server, forget_clients

pytestmark = pytest.mark.long


def query(warehouse: Warehouse, statement: str) -> Any:
    """Ask as `fleet-slip sql` does."""
    with connect(warehouse.root, query=statement) as database:
        return database.sql(statement).fetchall()


QUESTIONS: dict[str, Callable[[Warehouse], Any]] = {
    "load_cohort": lambda w: load_cohort(w).tables[0].products.sum(),
    "fold sums": lambda w: load_cohort(w, folding=Folding()).rows,
    "publish": lambda w: publish_from(w, force=True).version.version,
    "score": lambda w: score(w, Registry(w.root / "models").resolve("beta").manifest, "true"),
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
    found, refused = {}, 0
    for name, ask in QUESTIONS.items():
        objects._fetched.clear()
        try:
            found[name] = ask(warehouse)
        except StorageError:
            refused += 1
    return found, refused


@pytest.mark.parametrize("path", ["/grams/[^_]", "/logs/day=", "/models/"])
def test_an_answer_with_a_flipped_bit_is_no_answer(
    server: Server, stored: Warehouse, path: str
) -> None:
    usual, none = ask_all(stored)
    assert none == 0
    with flipping(server, path):
        found, refused = ask_all(stored)
    assert refused
    assert found == {name: usual[name] for name in found}  # these did not look there
    assert ask_all(stored) == (usual, 0)


def test_single_flipped_answers_among_many_change_nothing(
    server: Server, stored: Warehouse
) -> None:
    usual, _ = ask_all(stored)
    refusals = 0
    for _ in range(4):
        with flipping(server, "/(grams/[^_]|logs/day=|models/)", 0.2):
            found, refused = ask_all(stored)
        refusals += refused
        assert found == {name: usual[name] for name in found}
    assert refusals


def test_gram_rows_are_not_made_of_flipped_logs(server: Server, stored: Warehouse) -> None:
    with flipping(server, "/logs/day="), pytest.raises(StorageError, match="do not match"):
        update_grams(stored, feature_set="motion")
    assert load_cohort(stored).drive_count == 16
    assert not verify(stored).damage
