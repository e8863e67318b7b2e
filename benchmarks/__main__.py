"""Runs every benchmark, one after the other: python -m benchmarks."""

import subprocess
import sys

MODULES = ("simulator", "pipeline", "statistics", "observers")

for module in MODULES:
    print(f"\n== {module}", flush=True)
    subprocess.run([sys.executable, "-m", f"benchmarks.{module}"], check=True)
