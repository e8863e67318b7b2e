"""How fast messages of cars are taken in.

    python -m benchmarks.receive [--cars 20000] [--drives 5] [--folder FOLDER]

Writes a file of messages for each drive of all cars, receives them, and receives them again with a
message more in each file, so that all others are duplicates. Rows of one drive that was made up
stand for those of all: what they say costs nothing.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import fleet_slip
from fleet_slip.regression.gram import Gram
from tests.support.messages import START_S, gram_of, message_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cars", type=int, default=20_000)
    parser.add_argument("--drives", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        print(json.dumps(measure(Path(folder), given.cars, given.drives), indent=2))


def measure(folder: Path, cars: int, drives: int) -> dict[str, float]:
    """Return messages a second, of new ones and of duplicates, and bytes of a message and a row."""
    grams = [gram_of(seed) for seed in range(50)]
    fleet = fleet_slip.open(folder / "data")
    paths = []
    for drive in range(drives):
        start_s = START_S + 86_400 * drive
        messages = (message_of(grams[car % 50], f"CAR{car}", start_s) for car in range(cars))
        paths.append(folder / f"day-{drive}")
        paths[-1].write_bytes(b"".join(messages))
    size = sum(path.stat().st_size for path in paths)
    fleet.receive(write_first(folder, grams[0]))  # and have everything imported
    began = time.perf_counter()
    received = sum(report.received for report in fleet.receive(paths))
    first = time.perf_counter() - began
    for path in paths:
        path.write_bytes(path.read_bytes() + message_of(grams[0], "MORE"))
    began = time.perf_counter()
    duplicates = sum(report.duplicates for report in fleet.receive(paths))
    again = time.perf_counter() - began
    stored = sum(file.size_bytes for file in fleet.warehouse.grams.snapshot().files)
    return {
        "messages": received,
        "messages_per_s": round(received / first),
        "duplicates": duplicates,
        "duplicates_per_s": round(duplicates / again),
        "message_bytes": size / received,
        "stored_bytes_per_row": round(stored / (received + 1), 1),
    }


def write_first(folder: Path, gram: Gram) -> Path:
    (folder / "first").write_bytes(message_of(gram, "FIRST"))
    return folder / "first"


if __name__ == "__main__":
    main()
