"""The history of runs where each record is an object."""

from datetime import UTC, datetime, timedelta

from fleet_slip.operations.status import status_of
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.runs import Run, write_line
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse
from tests.support.s3_server import Server


def history(root: Folder) -> list[tuple[object, ...]]:
    with connect(root, query="runs") as database:
        return database.execute(
            "SELECT arguments[1], command, outcome, rows FROM runs ORDER BY ALL"
        ).fetchall()


def test_status_asks_for_no_record_older_than_a_year(root: Folder, server: Server) -> None:
    record_old(root, days=800)
    record_old(root, days=30)
    with server.misbehaving() as watched:
        (last,) = status_of(Warehouse(root)).last_runs
    assert last["started_at"] > datetime.now(UTC) - timedelta(days=31)
    assert len({request for request in watched.seen if "/runs/" in request}) == 2
    assert len(history(root)) == 2


def record_old(root: Folder, days: int) -> None:
    run = Run.start("gram", [])
    run.started_at -= timedelta(days=days)
    run.run_id = f"{days}"
    for line in (run.beginning(), run.end(None, 1.0)):
        root.append(f"runs/{run.started_at:%Y-%m}.jsonl", write_line(line) + b"\n")
