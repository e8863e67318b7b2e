"""The history of runs where each record is an object: gathered, and lost or doubled by nothing."""

import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import pytest

from fleet_slip.operations.find_drives import vacuum
from fleet_slip.operations.status import status_of
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.runs import Run, gather_runs, recording, step
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse
from tests.support.s3_server import Server


def record(root: Folder, name: str) -> None:
    with recording(root, "gram", [name]), step("gram") as figures:
        figures.rows = 7


def history(root: Folder) -> list[tuple[object, ...]]:
    with connect(root, query="runs") as database:
        return database.execute(
            "SELECT arguments[1], command, outcome, rows FROM runs ORDER BY ALL"
        ).fetchall()


def objects(root: Folder) -> list[str]:
    return [file.path for file in (root / "runs").files()]


def test_gathered_records_are_one_object_and_the_same_history(root: Folder) -> None:
    root.put("other", b"")  # a data root that is there
    for number in range(3):
        record(root, f"{number}")
    with recording(root, "run", ["under way"]):
        before = history(root)
        assert (len(before), len(objects(root))) == (4, 7)
        assert gather_runs(root) == 7
        assert len(objects(root)) == 1
        assert history(root) == before
    assert gather_runs(root) == 2
    assert gather_runs(root) == 0
    assert Counter(outcome for _, _, outcome, _ in history(root)) == {"done": 4}
    vacuum(Warehouse(root))
    assert history(root)[0] == ("0", "gram", "done", 7)


@pytest.mark.long
def test_records_gathered_by_many_while_others_write_and_read(root: Folder, server: Server) -> None:
    root.put("other", b"")
    with server.misbehaving(failing=0.05, slow_s=0.005), ThreadPoolExecutor(8) as executor:
        writing = [executor.submit(record, root, f"{number}") for number in range(20)]
        gathering = [executor.submit(gather_runs, root) for _ in range(6)]
        reading = [executor.submit(history, root) for _ in range(6)]
        faults = [task.exception() for task in gathering] + [task.exception() for task in reading]
    assert (faults, {task.exception() for task in writing}) == ([None] * 12, {None})
    expected = sorted((f"{number}", "gram", "done", 7) for number in range(20))
    assert history(root) == expected
    gather_runs(root)
    assert (len(objects(root)), history(root)) == (1, expected)


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
        root.append(f"runs/{run.started_at:%Y-%m}.jsonl", json.dumps(line).encode() + b"\n")
