"""How fast messages of cars are taken in.

    python -m benchmarks.receive [--cars 20000] [--drives 5] [--forgotten 1] [--signed]
        [--a-day 12] [--folder FOLDER]

Writes a file of messages for each day, one of each car, all different; receives them, and receives
them again with a message more in each file, so that all others are duplicates. Sums and products
are those that drives of 20 s to an hour have whose signals vary at random with each other.
With `--forgotten`, the first day lands, then so many cars are forgotten, each in turn a car and a
single drive of another one; what is measured are the other days, and then messages of a few cars
that nobody knew. With `--signed`, each car signs by a key of its own; with `--a-day`, too, each
car sends so many messages a day with one signature for all. What checking alone takes of the
processor is measured on the first day.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np

import fleet_slip
from fleet_slip.grams.received.car_keys import KEYS_VARIABLE, load_car_keys
from fleet_slip.grams.received.found_messages import read_messages
from fleet_slip.grams.received.signatures import judge_signatures, sign_days, sign_messages
from fleet_slip.grams.received.sound_messages import by_layout
from fleet_slip.models.ed25519 import generate
from fleet_slip.regression.exact.gram import Gram
from tests.support.fleet_messages import messages_of
from tests.support.messages import START_S, gram_of, message_of

UNKNOWN = 100
"""Cars that come after others were forgotten."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("cars", 20_000), ("drives", 5), ("forgotten", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--signed", action="store_true")
    parser.add_argument("--a-day", type=int, help="messages of a car and day under one signature")
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        keys = make_keys(Path(folder), given.cars) if given.signed or given.a_day else None
        found = measure(Path(folder), given, keys)
        print(json.dumps(found, indent=2))


def measure(folder: Path, given: argparse.Namespace, keys: list[bytes] | None) -> dict[str, float]:
    """Return messages a second, of new ones and of duplicates, and bytes of a message and a row."""
    cars, drives, forgotten, a_day = given.cars, given.drives, given.forgotten, given.a_day
    first = gram_of(0)
    fleet = fleet_slip.open(folder / "data")
    paths = []
    for drive in range(drives):
        paths.append(folder / f"day-{drive}")
        starts = [START_S + 86_400 * drive + 3000 * at for at in range(a_day or 1)]
        parts = [messages_of(cars, at, seed=at) for at in starts]
        content = b"".join(each(parts, cars))
        paths[-1].write_bytes(content if keys is None else signed(content, keys, days=bool(a_day)))
    size_bytes = paths[0].stat().st_size / (cars * (a_day or 1))
    checked = check_alone(paths[0]) if keys else 0.0
    fleet.receive(write_first(folder, first, keys))  # and have everything imported
    if forgotten:
        fleet.receive(paths.pop(0))
        forget_some(fleet, forgotten)
    began, processor_s = time.perf_counter(), time.process_time()
    received = sum(report.received for report in fleet.receive(paths))
    first_s, processor_s = time.perf_counter() - began, time.process_time() - processor_s
    for path in paths:
        content = path.read_bytes()
        path.write_bytes(content + content[-int(size_bytes) :])
    began = time.perf_counter()
    duplicates = sum(report.duplicates for report in fleet.receive(paths))
    again_s = time.perf_counter() - began
    unknown_s = receive_unknown(fleet, folder) if forgotten else 0.0
    stored = fleet.warehouse.grams.snapshot().files
    stored_bytes = sum(file.size_bytes for file in stored) / sum(file.rows for file in stored)
    return {
        "messages": received,
        "messages_per_s": round(received / first_s),
        "messages_per_processor_s": round(received / processor_s),
        "signatures_checked_per_processor_s": round(checked),
        "duplicates": duplicates,
        "duplicates_per_s": round(duplicates / again_s),
        "ms_for_a_car_that_nobody_knew": round(1e3 * unknown_s / UNKNOWN, 2),
        "message_bytes": size_bytes,
        "stored_bytes_per_row": round(stored_bytes, 1),
    }


def make_keys(folder: Path, cars: int) -> list[bytes]:
    """Return a private key of each car, the last of `FIRST`; name the list of public ones."""
    private, public = zip(*(generate() for _ in range(cars + 1)), strict=True)
    names = [*(f"CAR{car}" for car in range(cars)), "FIRST"]
    lines = [f"{n},{key.decode().splitlines()[1]}" for n, key in zip(names, public, strict=True)]
    (folder / "keys.csv").write_text("\n".join(["vehicle_id,public_key", *lines]))
    os.environ[KEYS_VARIABLE] = str(folder / "keys.csv")
    began = time.perf_counter()
    load_car_keys()
    print(f"the list of keys was read in {time.perf_counter() - began:.1f} s")
    return list(private)


def each(parts: list[bytes], cars: int) -> Iterator[bytes]:
    """Yield messages by car, of several parts that have one of each."""
    size = len(parts[0]) // cars
    for at, part in product(range(0, len(parts[0]), size), parts):
        yield part[at : at + size]


def signed(content: bytes, keys: list[bytes], *, days: bool) -> bytes:
    """Return the messages of each car, signed by its key."""
    size = len(content) // (len(keys) - 1)
    whole = (content[at : at + size] for at in range(0, len(content), size))
    sign = sign_days if days else sign_messages
    return b"".join(sign(some, key) for some, key in zip(whole, keys, strict=False))


def check_alone(path: Path) -> float:
    """Return how many messages of a file are checked in a second of the processor."""
    keys = load_car_keys()
    assert keys
    rows = list(by_layout(0, read_messages(path.read_bytes())))
    judge_signatures(rows[0].take(np.arange(1)), keys)  # and have everything imported
    began = time.process_time()
    for some in rows:
        assert not any(judge_signatures(some, keys))
    return sum(map(len, rows)) / (time.process_time() - began)


def forget_some(fleet: fleet_slip.Fleet, many: int) -> None:
    """Forget some cars, and single drives of others."""
    for car in range(many):
        if car % 2 == 0:
            fleet.forget(vehicle=f"CAR{car}", now=True)
        else:
            fleet.forget(drive=f"CAR{car}-20240501T100000Z", now=True)


def receive_unknown(fleet: fleet_slip.Fleet, folder: Path) -> float:
    """Return the seconds that messages of cars take of which no message ever came."""
    messages = [message_of(gram_of(car), f"NEW{car}") for car in range(UNKNOWN)]
    (folder / "unknown").write_bytes(b"".join(messages))
    began = time.perf_counter()
    fleet.receive(folder / "unknown")
    return time.perf_counter() - began


def write_first(folder: Path, gram: Gram, keys: list[bytes] | None) -> Path:
    message = message_of(gram, "FIRST")
    (folder / "first").write_bytes(sign_messages(message, keys[-1]) if keys else message)
    return folder / "first"


if __name__ == "__main__":
    main()
