"""OpenLineage events of commands: to a file, to a server, and without either."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.support.commands import RunCommand

CSV = "time_s,ay\n" + "".join(f"{tick / 100},0.5\n" for tick in range(300))
MAPPING = """
name = "loggers"
[drive]
vehicle_id = "car"
vehicle_model = "sedan"
day = 2024-05-31
[time]
column = "time_s"
unit = "s"
[signals]
ay = { column = "ay", unit = "m/s^2" }
"""


@pytest.fixture
def server() -> Iterator[tuple[str, list[tuple[str, Any]]]]:
    """The address of a server on this machine, and the path and content of each request."""
    requests: list[tuple[str, Any]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            requests.append((self.path, json.loads(body)))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    http = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=http.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{http.server_port}", requests
    http.shutdown()
    thread.join()
    http.server_close()


def names(datasets: list[dict[str, Any]]) -> set[str]:
    return {Path(dataset["name"]).name for dataset in datasets}


def test_an_ingest_names_the_folder_that_it_read_and_the_table_that_it_wrote(
    run_command: RunCommand, tmp_path: Path
) -> None:
    (tmp_path / "inbox").mkdir()
    (tmp_path / "inbox/jane.csv").write_text(CSV)
    (tmp_path / "loggers.toml").write_text(MAPPING)
    arguments = ("ingest", "inbox/jane.csv", "--mapping", "loggers.toml")
    done = run_command("--lineage", "events.jsonl", *arguments)
    assert done.exit_code in (0, 10), done.stderr
    text = (tmp_path / "events.jsonl").read_text()
    start, end = map(json.loads, text.splitlines())
    assert (start["eventType"], start["outputs"]) == ("START", [])
    assert start["run"]["runId"] == end["run"]["runId"]
    assert end["eventType"] == ("COMPLETE" if done.exit_code == 0 else "FAIL")
    assert end["job"]["name"] == "ingest"
    assert names(end["inputs"]) == {"inbox"}
    assert names(end["outputs"]) == {"logs"}
    assert end["outputs"][0]["facets"]["version"]["datasetVersion"].isdigit()
    assert "jane" not in text


def test_a_failed_run_has_its_message_and_reads_a_version(
    run_command: RunCommand, smoke_copy: Path, server: tuple[str, list[tuple[str, Any]]]
) -> None:
    address, requests = server
    assert run_command("--lineage", address, "gram").exit_code == 0
    failed = run_command("--lineage", f"{address}/collect", "publish", "not a name")
    assert failed.exit_code == 2
    events = [event for _, event in requests]
    assert [event["eventType"] for event in events] == ["START", "COMPLETE", "START", "FAIL"]
    assert [path for path, _ in requests] == 2 * ["/api/v1/lineage"] + 2 * ["/collect"]
    assert names(events[1]["inputs"]) == {"logs"}
    assert "version" in events[1]["inputs"][0]["facets"]
    message = events[-1]["run"]["facets"]["errorMessage"]["message"]
    assert "cannot be the name of a model" in message


def test_a_run_on_a_damaged_table_fails_in_its_events_too(
    run_command: RunCommand, smoke_copy: Path, tmp_path: Path
) -> None:
    (smoke_copy / "logs/_delta_log/00000000000000000000.json").write_text("x")
    events = tmp_path / "events.jsonl"
    assert run_command("--lineage", str(events), "gram").exit_code == 6
    states = [json.loads(line)["eventType"] for line in events.read_text().splitlines()]
    assert states == ["START", "FAIL"]


def test_a_run_goes_on_without_the_server_and_warns(
    run_command: RunCommand, smoke_copy: Path
) -> None:
    done = run_command("--lineage", "http://user:secret@127.0.0.1:9", "gram")
    assert done.exit_code == 0
    assert done.stderr.count("cannot be sent to http://***@127.0.0.1:9") == 2
    assert "secret" not in done.stderr


@pytest.mark.parametrize(
    "target", ["absent/events.jsonl", ".", "http://", "ftp://host/x", "http://h:99999"]
)
def test_a_target_that_cannot_be_is_refused_before_the_run(
    run_command: RunCommand, smoke_copy: Path, target: str
) -> None:
    refused = run_command("--lineage", target, "gram")
    assert refused.exit_code == 2
    assert f"--lineage {target}: " in refused.stderr
