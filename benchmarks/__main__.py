"""Runs every benchmark, one after the other: python -m benchmarks."""

import subprocess
import sys

COMMANDS = (
    "simulator",
    "simulator_profile",
    "work_precision",
    "pipeline",
    "statistics",
    "observers",
    "reliability",
    "crash --kills 30",
)

for command in COMMANDS:
    print(f"\n== {command}", flush=True)
    subprocess.run([sys.executable, "-m", *f"benchmarks.{command}".split()], check=True)
