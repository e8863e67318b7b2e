"""A version in a real MLflow server, on SQLite: registered, loaded back, and compared."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

import fleet_slip
from fleet_slip.errors import ConfigError, StorageError, UsageError
from fleet_slip.export.mlflow import describe, parameters, require_answer

START_S = 120


def folder_of_mlflow() -> Path:
    """The folder of programs of MLflow's own environment, which has fleet-slip too."""
    program = shutil.which("mlflow")
    assert program
    return Path(program).resolve().parent


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("mlflow")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    store = ["--backend-store-uri", f"sqlite:///{folder / 'mlflow.db'}"]
    where = ["--artifacts-destination", str(folder / "artifacts"), "--workers", "1"]
    words = [str(folder_of_mlflow() / "mlflow"), "server", *store, *where, "--port", str(port)]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            words, cwd=folder, stdout=log, stderr=log, start_new_session=True
        )
    uri = f"http://127.0.0.1:{port}"
    try:
        wait_for(uri, process)
        yield uri
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(30)


def wait_for(uri: str, process: "subprocess.Popen[bytes]") -> None:
    until = time.monotonic() + START_S
    while time.monotonic() < until and process.poll() is None:
        try:
            with urllib.request.urlopen(f"{uri}/health", timeout=5):  # noqa: S310 - our own
                return
        except (urllib.error.URLError, OSError):
            time.sleep(0.5)
    pytest.fail("the server of MLflow does not answer")


def test_a_registered_version_says_what_it_is(smoke_root: Path) -> None:
    version, client = fleet_slip.open(smoke_root).models.get("smoke"), Mock()
    describe(client, version, "7", {"champion": version.version, "old": version.version + 1})
    ((arguments, text),) = client.update_model_version.call_args_list
    assert arguments == ("smoke", "7")
    assert text["description"].startswith("smoke@1 of fleet_slip, trained on 8 drives where ")
    client.set_registered_model_alias.assert_called_once_with("smoke", "champion", "7")
    assert parameters(version)["drives"] == "8"
    assert max(map(len, parameters(version).values())) <= 500


LOAD = """
import json, sys
import mlflow, numpy as np, fleet_slip
uri, root, drive = sys.argv[1:]
mlflow.set_tracking_uri(uri)
fleet = fleet_slip.open(root)
version = fleet.models.get("logged")
chosen = f"drive_id = '{drive}' AND tick < 3000"
frame = fleet.sql(f"SELECT * FROM log WHERE {chosen} ORDER BY tick").df()
model = mlflow.pyfunc.load_model("models:/logged/1")
names = [one.name for one in model.metadata.get_input_schema().inputs]
told = [name for name in names if name in frame]
doubles = [name for name in told if name not in ("drive_id", "tick")]
found = model.predict(frame[told].astype(dict.fromkeys(doubles, "float64")))
client = mlflow.MlflowClient()
registered = client.search_model_versions("name = 'logged'")
run = client.get_run(registered[0].run_id)
print(json.dumps({
    "equal": bool(np.array_equal(found["sideslip_rad"], version.predict(frame))),
    "rows": len(found), "versions": len(registered), "tags": registered[0].tags,
    "metrics": run.data.metrics, "inputs": names,
    "example": model.metadata.saved_input_example_info is not None,
}))
"""


@pytest.mark.tools("mlflow")
def test_a_version_is_registered_once_and_loads_back(
    smoke_root: Path, server: str, tmp_path: Path
) -> None:
    root = tmp_path / "data"
    shutil.copytree(smoke_root, root)
    programs = folder_of_mlflow()
    command = [programs / "fleet-slip", "--root", root]
    run(*command, "publish", "logged")
    for _ in range(2):
        done = run(*command, "export", "logged", "--to", "mlflow", "--uri", server)
        assert "in MLflow: logged, version 1" in done.stderr
    drive = "smoke-2024-05-01-0003"
    done = run(programs / "python", "-c", LOAD, server, root, drive)
    document: dict[str, Any] = json.loads(done.stdout)
    version = fleet_slip.open(root).models.get("logged")
    assert (document["equal"], document["rows"], document["versions"], document["example"]) == (
        True,
        3000,
        1,
        True,
    )
    assert document["tags"]["fleet_slip.sha256"] == version.sha256
    assert document["tags"]["fleet_slip.reference"] == "logged@1"
    figures = version.manifest.cross_validation
    assert document["metrics"]["correlation"] == pytest.approx(figures.correlation, rel=1e-12)
    assert set(version.columns) <= set(document["inputs"])


def run(*words: Any) -> "subprocess.CompletedProcess[str]":
    done = subprocess.run(
        list(map(str, words)), capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done


def test_without_the_library_the_extra_is_named(
    smoke_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mlflow", None)
    fleet = fleet_slip.open(smoke_root)
    with pytest.raises(ConfigError, match=r'mlflow. Run: pip install "fleet-slip\[mlflow\]"'):
        fleet.models.log_to_mlflow("smoke", "http://127.0.0.1:9")
    with pytest.raises(UsageError, match="contains a name or password"):
        fleet.models.log_to_mlflow("smoke", "http://me:secret@127.0.0.1:9")


@pytest.mark.parametrize("listening", [True, False])
def test_a_server_that_says_nothing_is_not_waited_for(listening: bool) -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        if listening:
            silent.listen()
        uri = f"http://127.0.0.1:{silent.getsockname()[1]}"
        message = f"ours@1 is published here, but MLflow rejected it: nothing answers at {uri}"
        with pytest.raises(StorageError, match=message):
            require_answer(uri, "ours@1", 0.2)


def test_a_store_that_is_no_server_is_not_asked() -> None:
    require_answer("sqlite:///mlflow.db", "ours@1")
