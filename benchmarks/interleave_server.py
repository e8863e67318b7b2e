"""An S3 server in a process of its own, beside commands that fork."""

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def serving(**faults: float) -> Iterator[tuple[str, str]]:
    """Start a server, let this process find it, and return its URL and a bucket.

    `faults` says how it misbehaves, as `tests.support.s3_server.Faults`.
    """
    methods = multiprocessing.get_context("spawn")
    here, there = methods.Pipe()
    process = methods.Process(target=_serve, args=(there, faults), daemon=True)
    process.start()
    environment, bucket = here.recv()
    os.environ.update(environment)
    yield environment["AWS_ENDPOINT_URL"], bucket
    process.terminate()
    process.join()


def _serve(connection: Any, faults: dict[str, float]) -> None:
    from tests.support.s3_server import Server  # noqa: PLC0415 - flask and moto, here only

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    server = Server()
    connection.send((server.environment, server.bucket().removeprefix("s3://")))
    with server.misbehaving(**faults):
        signal.pause()
