"""What commands on an object store cost as the history of runs grows: requests, and seconds.

    python -m benchmarks.store_history [--sizes 1e3 1e4 1e5] [--scattered]

The store is moto's server in this process, so that the seconds are mostly its own; the requests
are what a store far away makes slow and asks money for. There was a run every hour, and `vacuum`
gathered their records a week ago, or never.
"""

import argparse
import json
import os
import subprocess
import time
from collections import defaultdict
from datetime import UTC, datetime, timedelta

from moto.core.models import DEFAULT_ACCOUNT_ID
from moto.s3.models import s3_backends

from benchmarks.billion import PROGRAM
from tests.support.growth_history import records_of_run
from tests.support.s3_server import Server

RUN = ("run", "--campaign", "smoke", "--days", "1")
STATUS = ("status",)
COUNT = ("sql", "SELECT count(*) FROM runs")
VACUUM = ("vacuum",)
COMMANDS = (RUN, STATUS, COUNT, VACUUM, STATUS, COUNT)
WEEK = timedelta(days=7)


def records(count: int, scattered: bool) -> dict[str, bytes]:
    """Return names and contents of the records of so many runs up to now, two for each.

    Those of last week are objects of their own, older ones only if they are `scattered`.
    """
    found: dict[str, bytearray] = defaultdict(bytearray)
    for i in range(count):
        age = timedelta(hours=i + 1)
        at = datetime.now(UTC) - age
        name = f"{at:%Y%m%dT%H%M%S.%fZ}-{i:08x}"
        for part, line in enumerate(records_of_run(name, at)):
            stamp = f"{int(at.timestamp() * 1e9) + part:020d}-{i:08x}"
            key = stamp if scattered or age < WEEK else "0" * 32
            found[f"runs/{at:%Y-%m}.jsonl/{key}.jsonl"] += json.dumps(line).encode() + b"\n"
    return {key: bytes(content) for key, content in found.items()}


def measured(server: Server, root: str, command: tuple[str, ...]) -> tuple[int, float]:
    """Return the requests and the seconds of a command."""
    with server.misbehaving() as watched:
        began = time.perf_counter()
        done = subprocess.run(
            [*PROGRAM, "--root", root, *command],
            check=False,
            capture_output=True,
            text=True,
            env=os.environ | server.environment,
        )
        seconds = time.perf_counter() - began
    assert done.returncode in (0, 10), done.stderr
    return len(watched.seen), seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sizes", type=float, nargs="*", default=[1e3, 1e4, 1e5])
    parser.add_argument("--scattered", action="store_true", help="never gathered")
    options = parser.parse_args()
    server = Server()
    print("| runs | command | requests | s |\n| ---: | --- | ---: | ---: |")
    for size in (round(size) for size in options.sizes):
        bucket = server.bucket()
        measured(server, f"{bucket}/data", RUN)
        backend = s3_backends[DEFAULT_ACCOUNT_ID]["aws"]
        for key, content in records(size, options.scattered).items():
            backend.put_object(bucket.removeprefix("s3://"), f"data/{key}", content)
        for command in COMMANDS:
            requests, seconds = measured(server, f"{bucket}/data", command)
            text = f"| {size:,} | `{' '.join(command)}` | {requests:,} | {seconds:.1f} |"
            print(text, flush=True)
    server.stop()


if __name__ == "__main__":
    main()
