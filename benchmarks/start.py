"""How long a command takes to start, beside Python itself.

    python -m benchmarks.start [--rounds 15]

Every command is a process of its own, on a data root with one model. In each round all take turns,
Python without a program among them; a median is told, and how many times that of Python it is.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict

PROGRAM = "from fleet_slip.cli.main import main; main()"
COMMANDS = (
    ("--help",),
    ("show", "smoke"),
    ("models",),
    ("status",),
    ("sql", "SELECT 1"),
    ("select", "--help"),
    ("gram",),
)


def seconds(command: list[str]) -> float:
    """Return how long a process takes. `status` leaves with a code of its own."""
    start = time.perf_counter()
    subprocess.run(command, capture_output=True, check=False)
    return time.perf_counter() - start


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as root:
        program = [sys.executable, "-c", PROGRAM, "--root", root]
        subprocess.run([*program, "run", "--campaign", "smoke"], check=True, capture_output=True)
        cases = {"python": [sys.executable, "-c", "pass"]}
        cases |= {" ".join(arguments): [*program, *arguments] for arguments in COMMANDS}
        times = defaultdict(list)
        for _ in range(rounds):
            for name, command in cases.items():
                times[name].append(seconds(command))
    python = statistics.median(times["python"])
    for name, durations in times.items():
        middle = statistics.median(durations)
        print(f"{name:20s} {middle * 1e3:6.0f} ms  {middle / python:5.1f} times Python itself")


if __name__ == "__main__":
    main()
