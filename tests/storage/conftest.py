"""An S3 server, and data roots on it."""

from collections.abc import Iterator

import pytest

from fleet_slip.storage.folder import Folder
from fleet_slip.storage.local import data_root
from tests.support.s3_server import Server, ServerApart, forget_clients


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    started = Server()
    yield started
    started.stop()


@pytest.fixture(autouse=True)
def environment(server: "Server | ServerApart", monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The address of the server, for this process and those that it starts."""
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    yield
    forget_clients()


@pytest.fixture
def root(server: Server) -> Folder:
    """An empty data root on the server."""
    return data_root(f"{server.bucket()}/data")
