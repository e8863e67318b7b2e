"""An S3 server for tests: moto's, on 127.0.0.1, behind a layer that can be told to misbehave.

The layer makes conditional puts atomic, which moto's are not among threads, and knows one access
key, since moto takes any.
"""

import io
import json
import random
import re
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from werkzeug.serving import BaseWSGIServer, WSGIRequestHandler, make_server

from fleet_slip.storage.objects import RETRIES, client
from tests.support.commands import PATIENCE_S, Finished, run_on, start

ACCESS_KEY = "AKIDFORTESTS"
SECRET_KEY = "s3cr3t/of+tests"  # noqa: S105 - for a server of our own
SCOPE = "20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0"

Environ = dict[str, Any]
StartResponse = Callable[..., Any]


@dataclass
class Faults:
    """How the server misbehaves; by default it does not.

    Attributes:
        failing: share of the requests that are answered by 500, half of them after they were done.
            Below 1, no request fails more often than clients repeat it: all get through.
        slow_s: longest time by which an answer is late.
        refuse: methods that are answered by 403.
        access_key: the one that is let in.
        flipping: one bit is flipped in some answers to GET whose path this pattern finds.
        flipped: share of those answers.
        bytes_per_s: how fast answers to GET of objects come, if not at once.
        seen: requests that came, as METHOD PATH.
        failures: how often each request, as METHOD PATH QUERY, was answered by 500.
    """

    failing: float = 0.0
    slow_s: float = 0.0
    refuse: tuple[str, ...] = ()
    access_key: str = ACCESS_KEY
    flipping: str = r"(?!)"
    flipped: float = 1.0
    bytes_per_s: float | None = None
    seen: list[str] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)


class Server:
    """A running server; every bucket that is asked for by `bucket` is new."""

    def __init__(self) -> None:
        from moto.moto_server import werkzeug_app as moto  # noqa: PLC0415 - a second, for a server

        self.faults = Faults()
        self._rng = random.Random(0)  # noqa: S311
        self._conditional = threading.Lock()
        self._moto = moto.DomainDispatcherApplication(moto.create_backend_app)
        self._server: BaseWSGIServer = make_server(
            "127.0.0.1", 0, self, threaded=True, request_handler=_Quiet
        )
        self._buckets = 0
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def environment(self) -> dict[str, str]:
        """The address of the server, and its credentials."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self._server.server_port}",
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": ACCESS_KEY,
            "AWS_SECRET_ACCESS_KEY": SECRET_KEY,
            "AWS_EC2_METADATA_DISABLED": "true",
        }

    def stop(self) -> None:
        self._server.shutdown()

    def bucket(self) -> str:
        """Make a bucket and return its URL."""
        self._buckets += 1
        name = f"fleet-{self._buckets}"
        request = urllib.request.Request(
            f"http://127.0.0.1:{self._server.server_port}/{name}",
            method="PUT",
            headers={"Authorization": f"AWS4-HMAC-SHA256 Credential={ACCESS_KEY}/{SCOPE}"},
        )
        urllib.request.urlopen(request, timeout=PATIENCE_S).close()  # noqa: S310
        return f"s3://{name}"

    @contextmanager
    def misbehaving(self, **faults: Any) -> Iterator[Faults]:
        """Misbehave for a while."""
        self.faults = Faults(**faults)
        try:
            yield self.faults
        finally:
            self.faults = Faults()

    def __call__(self, environ: Environ, start: StartResponse) -> Iterable[bytes]:
        faults, method = self.faults, environ["REQUEST_METHOD"]
        faults.seen.append(f"{method} {environ['PATH_INFO']}")
        length = int(environ.get("CONTENT_LENGTH") or 0)
        environ["wsgi.input"] = io.BytesIO(environ["wsgi.input"].read(length))
        if faults.slow_s:
            time.sleep(self._rng.uniform(0, faults.slow_s))
        if f"Credential={faults.access_key}/" not in environ.get("HTTP_AUTHORIZATION", ""):
            return _answer(start, "403 Forbidden", "InvalidAccessKeyId")
        if method in faults.refuse:
            return _answer(start, "403 Forbidden", "AccessDenied")
        fate = self._rng.random()
        request = f"{method} {environ['PATH_INFO']} {environ['QUERY_STRING']}"
        is_certain = faults.failing >= 1
        if fate < faults.failing and (is_certain or faults.failures[request] < RETRIES):
            faults.failures[request] += 1
            if fate >= faults.failing / 2:
                list(self._served(environ, lambda *_: None))
            return _answer(start, "500 Internal Server Error", "InternalError")
        answer = self._served(environ, start)
        flipping = method == "GET" and re.search(faults.flipping, environ["PATH_INFO"])
        if flipping and self._rng.random() < faults.flipped:
            return [self._flip(b"".join(answer))]
        if faults.bytes_per_s and method == "GET" and not environ["QUERY_STRING"]:
            return _slowly(b"".join(answer), faults.bytes_per_s)
        return answer

    def _flip(self, content: bytes) -> bytes:
        damaged = bytearray(content)
        if damaged:
            damaged[self._rng.randrange(len(damaged))] ^= 1 << self._rng.randrange(8)
        return bytes(damaged)

    def _served(self, environ: Environ, start: StartResponse) -> Iterable[bytes]:
        guard = self._conditional if "HTTP_IF_NONE_MATCH" in environ else nullcontext()
        with guard:
            answer: Iterable[bytes] = self._moto(environ, start)
            return answer


PROGRAM = """
import json, sys
from tests.support.s3_server import Faults, Server
server = Server()
print(json.dumps(server.environment), flush=True)
for asked in map(json.loads, sys.stdin):
    answer = server.bucket() if asked == "bucket" else server.faults.seen
    server.faults = Faults(**(asked if isinstance(asked, dict) else {}))
    print(json.dumps(answer), flush=True)
"""


class ServerApart:
    """A server in a process of its own, so that commands can run in the process of the tests.

    deltalake keeps Python's lock while it waits for a server, which that would need to answer.
    """

    def __init__(self) -> None:
        words = [sys.executable, "-c", PROGRAM]
        self._process = start(words, stdin=subprocess.PIPE, cwd=Path(__file__).parents[2])
        self.environment: dict[str, str] = self._answer()

    def bucket(self) -> str:
        """Make a bucket and return its URL."""
        return str(self._answer("bucket"))

    def seen(self) -> list[str]:
        """Return the requests that came since this was asked, or a bucket made."""
        return list(self._answer("seen"))

    @contextmanager
    def misbehaving(self, **faults: Any) -> Iterator[None]:
        """Misbehave for a while."""
        self._answer(faults)
        try:
            yield
        finally:
            self._answer({})

    def stop(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _answer(self, _query: object = None) -> Any:
        assert self._process.stdin and self._process.stdout
        if _query is not None:
            self._process.stdin.write(f"{json.dumps(_query)}\n")
            self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def command_on(root: object, *arguments: str) -> Finished:
    """Run a command as a user would, on a `ServerApart`, and look for keys in what it prints."""
    done = run_on(root, *arguments)
    for text in (done.stdout, done.stderr):
        assert not [secret for secret in (ACCESS_KEY, SECRET_KEY) if secret in text]
    return done


def forget_clients() -> None:
    """Let this process make its clients anew, as a new one would."""
    client.cache_clear()


def _answer(start: StartResponse, status: str, code: str) -> Iterable[bytes]:
    body = f"<Error><Code>{code}</Code><AWSAccessKeyId>{ACCESS_KEY}</AWSAccessKeyId></Error>"
    start(status, [("Content-Type", "application/xml"), ("Content-Length", str(len(body)))])
    return [body.encode()]


def _slowly(content: bytes, bytes_per_s: float) -> Iterator[bytes]:
    """Yield an answer as a slow network brings it, twenty times in a second, or byte by byte."""
    step = max(1, int(bytes_per_s / 20))
    for first in range(0, len(content), step):
        time.sleep(step / bytes_per_s)
        yield content[first : first + step]


class _Quiet(WSGIRequestHandler):
    def log(self, type: str, message: str, *args: Any) -> None:  # noqa: A002
        """Say nothing."""
