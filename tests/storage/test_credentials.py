"""Credentials in the files of Amazon's tools, as a user has them: no key in the environment."""

import contextlib
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fleet_slip.errors import StorageError
from fleet_slip.storage.data_root import data_root
from fleet_slip.storage.table import Change, Snapshot
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import DAY, log_rows, random_counts
from tests.support.s3_server import (
    ACCESS_KEY,
    SECRET_KEY,
    Server,
    command_on,
    forget_clients,
)
from tests.support.waiting import until

KEYS = f"aws_access_key_id = {ACCESS_KEY}\naws_secret_access_key = {SECRET_KEY}\n"

Files = Callable[[str, str], None]


@pytest.fixture
def files(server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Files:
    """Write ~/.aws/credentials and ~/.aws/config; the environment says nothing of keys."""
    for name in server.environment:
        if name not in ("AWS_ALLOW_HTTP", "AWS_EC2_METADATA_DISABLED"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "credentials"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "config"))

    def write(credentials: str, config: str) -> None:
        endpoint = server.environment["AWS_ENDPOINT_URL"]
        (tmp_path / "credentials").write_text(credentials)
        (tmp_path / "config").write_text(config.replace("ENDPOINT", f"endpoint_url = {endpoint}"))

    return write


def land(snapshot: Snapshot, drive: str = "a") -> None:
    """Write through both libraries."""
    rows = log_rows(drive, random_counts(np.random.default_rng(0), 20))
    snapshot.commit(Change(add=[snapshot.table.write_file(drive, rows, DAY)]))


@pytest.mark.long
def test_a_run_needs_nothing_but_the_files(server: Server, files: Files) -> None:
    files(f"[default]\n{KEYS}", "[default]\nregion = us-east-1\nENDPOINT\n")
    root = f"{server.bucket()}/data"
    done = command_on(root, "run", "--campaign", "smoke", "--days", "1")
    assert done.exit_code == 0, done.stderr
    assert command_on(root, "status").exit_code == 0


def test_a_profile_is_chosen_by_its_name(
    server: Server, files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = "[default]\naws_access_key_id = AKIDOFSOMEBODY\naws_secret_access_key = x\n"
    files(
        f"{wrong}[fleet]\n{KEYS}aws_session_token = token\n",
        "[default]\nENDPOINT\n[profile fleet]\nregion = us-east-1\nENDPOINT\n",
    )
    url = f"{server.bucket()}/data"
    with pytest.raises(StorageError, match="the store refuses the credentials"):
        land(Warehouse(data_root(url)).logs.snapshot())
    forget_clients()
    monkeypatch.setenv("AWS_PROFILE", "fleet")
    land(Warehouse(data_root(url)).logs.snapshot())
    assert Warehouse(data_root(url)).logs.snapshot().rows == 20


@pytest.mark.parametrize(
    ("credentials", "config", "told"),
    [
        (f"[default]\n{KEYS}", "", "there is no profile 'fleet'"),
        (f"[fleet\n{KEYS}", "", "ConfigParseError"),
        ("[fleet]\naws_access_key_id = AKIDOFSOMEBODY\n", "", "PartialCredentialsError"),
        ("", "[profile fleet]\ncredential_process = sh -c 'cat %s; exit 1'\n", "RetrievalError"),
        ("", "[profile fleet]\nregion = us-east-1\n", "there are no credentials for S3"),
    ],
)
def test_what_files_lack_is_told_without_what_they_say(
    files: Files,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    credentials: str,
    config: str,
    told: str,
) -> None:
    secrets = tmp_path / "secrets"
    secrets.write_text(f"{ACCESS_KEY} {SECRET_KEY}")
    files(credentials, config.replace("%s", str(secrets)))
    monkeypatch.setenv("AWS_PROFILE", "fleet")
    root = data_root("s3://bucket/data")
    for attempt in (root.exists, Warehouse(root).logs.snapshot):
        with pytest.raises(StorageError, match=told) as error:
            attempt()
        assert "\n" not in str(error.value)
        assert not [secret for secret in (ACCESS_KEY, SECRET_KEY) if secret in str(error.value)]


def test_temporary_credentials_are_had_anew_before_they_end(
    server: Server, files: Files, tmp_path: Path
) -> None:
    key, program = tmp_path / "key", tmp_path / "program"
    answer = {"Version": 1, "AccessKeyId": "$KEY", "SecretAccessKey": SECRET_KEY}
    answer |= {"SessionToken": "token", "Expiration": "$END"}
    program.write_text(  # the credentials that it gives last for eight seconds
        f"#!/bin/sh\nKEY=$(cat '{key}')\nEND=$(date -u -d '+8 seconds' +%Y-%m-%dT%H:%M:%SZ)\n"
        f"cat <<!\n{json.dumps(answer)}\n!\n"
    )
    program.chmod(0o755)
    files("", f"[default]\nregion = us-east-1\nENDPOINT\ncredential_process = '{program}'\n")
    key.write_text("AKIDTHATENDS")
    root = data_root(f"{server.bucket()}/data")
    logs = Warehouse(root).logs
    with server.misbehaving(access_key="AKIDTHATENDS"):
        land(logs.snapshot(), "a")
        snapshot = logs.snapshot()
    key.write_text(ACCESS_KEY)

    def landed() -> bool:
        with contextlib.suppress(StorageError):
            land(snapshot, "b")
            return True
        time.sleep(0.25)  # each attempt asks the program for credentials
        return False

    until(landed)
    assert logs.snapshot().rows == 40
