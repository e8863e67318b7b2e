"""Runs the benchmarks that need nothing but minutes, one after the other: python -m benchmarks.

The others are run by name: billion and growth need a folder and time, peers and weka other
programs.
"""

import subprocess
import sys

COMMANDS = (
    "start",
    "simulator",
    "simulator_profile",
    "work_precision",
    "pipeline",
    "gram_variants",
    "encoding --copies 1",
    "cluster",
    "observers",
    "reliability",
    "crash --kills 30",
)

for command in COMMANDS:
    print(f"\n== {command}", flush=True)
    subprocess.run([sys.executable, "-m", *f"benchmarks.{command}".split()], check=True)
