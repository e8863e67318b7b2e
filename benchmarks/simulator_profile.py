"""Where the time of `simulate` goes, stage by stage, and what the kernel's inner loops are made of.

    python -m benchmarks.simulator_profile [--campaign fleet_realistic] [--loop loop.s]

Stages: one file of a campaign, time of the processor on one thread, the best of several rounds.
Instructions: counted in the kernel's assembly. `--loop` writes the longest loop, a step of
four cars, for a simulator of the processor's pipeline:

    llvm-mca -mcpu=znver3 --bottleneck-analysis loop.s
"""

import argparse
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pyarrow as pa

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.simulation.campaign import Batch, load_campaign
from fleet_slip.simulation.job import lane_drive, simulate_logs, tabulate
from fleet_slip.simulation.sensors import Recorder
from fleet_slip.storage.checksums import checksum_of
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change
from fleet_slip.vehicle import batch_kernel
from fleet_slip.vehicle.batch import LaneDrive, simulate_blocks
from fleet_slip.warehouse.tables import Warehouse
from tests.support.whole_drives import simulate_drives

ROUNDS = 5


def best(function: Callable[[], Any], clock: Callable[[], float] = time.thread_time) -> float:
    """Return the shortest time of some calls, in s."""
    times = []
    for _ in range(ROUNDS):
        start = clock()
        function()
        times.append(clock() - start)
    return min(times)


def drive(drives: list[LaneDrive]) -> None:
    """Run the kernel and drop what it says."""
    for _ in simulate_blocks(drives):
        pass


def stages(batch: Batch, warehouse: Warehouse) -> tuple[int, dict[str, float]]:
    """Return the rows of a batch and the seconds of each stage on its way to the logs."""
    lanes = [lane_drive(spec) for spec in batch.drives]
    logs = simulate_logs(batch.drives)
    rows = tabulate(batch, logs)
    signals = [name for name in catalogue().signals if name in rows.schema.names]
    blocks = [
        (block.drive, {name: values.copy() for name, values in block.channels.items()})
        for block in simulate_blocks(lanes)
    ]

    def measure() -> None:
        recorders = [Recorder(s.sensors, s.generator(), s.distortion()) for s in batch.drives]
        for drive, truth in blocks:
            recorders[drive].record(truth)

    def distort() -> None:
        sensors = [spec.distortion() for spec in batch.drives]
        for drive, truth in blocks:
            if one := sensors[drive]:
                one.apply(truth)

    noise = np.empty(len(rows), dtype=np.float32)
    generator = batch.drives[0].generator()
    noisy = len(batch.drives[0].sensors.bias_and_std)
    encoded = warehouse.logs.encode(rows)
    draw_s = noisy * best(lambda: generator.standard_normal(out=noise, dtype=np.float32))
    distort_s = best(distort)
    others = [name for name in rows.schema.names if name not in signals]
    return len(rows), {
        "plan a day: cars, roads, speeds": best(
            lambda: load_campaign(batch.campaign).batches(batch.day)
        ),
        "roads of the drives": best(lambda: [lane_drive(spec) for spec in batch.drives]),
        "kernel": best(lambda: drive(lanes)),
        "sensors: draw the noise": draw_s,
        "sensors: imperfections": distort_s,
        "sensors: add it, round, clip": best(measure) - draw_s - distort_s,
        "tabulate": best(lambda: tabulate(batch, logs)),
        "encode: signals": best(lambda: warehouse.logs.encode(rows.select(signals))),
        "encode: tick and metadata": best(lambda: warehouse.logs.encode(rows.select(others))),
        "checksum (again in encode)": best(lambda: checksum_of(encoded.content)),
        "write and flush (elapsed)": best(
            lambda: warehouse.logs.put("profile", encoded, batch.day), time.perf_counter
        ),
        "commit (elapsed)": _commit_s(warehouse, rows, batch.day),
    }


def _commit_s(warehouse: Warehouse, rows: pa.Table, day: date) -> float:
    numbers = iter(range(ROUNDS))

    def commit() -> None:
        action = warehouse.logs.write_file(f"commit-{next(numbers)}", rows.slice(0, 100), day)
        warehouse.logs.snapshot().commit(Change(add=[action]))

    return best(commit, time.perf_counter)


def loops(assembly: str) -> list[list[str]]:
    """Return the instructions of the stretches without a label in between, longest first."""
    stretches: list[list[str]] = [[]]
    for line in assembly.splitlines():
        if re.match(r"\.L\w+:", line):
            stretches.append([])
        elif re.match(r"\t[a-z]", line):
            stretches[-1].append(line.strip())
    return sorted(stretches, key=len, reverse=True)


def compiled_assembly() -> str:
    """Return the kernel's assembly on this machine."""
    fresh = numba.njit(nogil=True, error_model="numpy")(batch_kernel.build_kernel())
    usual, batch_kernel.simulate = batch_kernel.simulate, fresh
    try:
        fleet = load_campaign("fleet")
        spec = fleet.batches(fleet.first_day)[0].drives[0]
        simulate_drives([lane_drive(replace(spec, laps=0.01))])
    finally:
        batch_kernel.simulate = usual
    (assembly,) = fresh.inspect_asm().values()
    return str(assembly)


def print_instructions(assembly: str) -> None:
    """Print what the longest stretches of the assembly are made of."""
    print(f"\n{'longest stretches of instructions':34}{'all':>6}{'divide':>8}{'root':>6}", end="")
    print(f"{'stack':>7}{'calls':>7}   most frequent")
    for number, body in enumerate(loops(assembly)[:3], 1):
        kinds = Counter(instruction.split()[0] for instruction in body)
        stack = sum("(%rsp)" in instruction for instruction in body)

        def count(kind: str, kinds: Counter[str] = kinds) -> int:
            return sum(n for name, n in kinds.items() if kind in name)

        frequent = ", ".join(f"{n} {name}" for name, n in kinds.most_common(5))
        print(f"{number:<34}{len(body):6}{count('div'):8}{count('sqrt'):6}{stack:7}", end="")
        print(f"{count('call'):7}   {frequent}")
    print(f"fused operations: {len(re.findall(r'vfn?m(?:add|sub)', assembly))}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--campaign", default="fleet")
    parser.add_argument("--loop", type=Path, help="file for the assembly of the longest loop")
    arguments = parser.parse_args()
    campaign = load_campaign(arguments.campaign)
    batch = campaign.batches(campaign.first_day)[0]
    with tempfile.TemporaryDirectory() as folder:
        rows, seconds = stages(batch, Warehouse(LocalFolder(Path(folder))))
    print(f"{rows:,} rows of {len(batch.drives)} drives\n{'stage':34}{'ms':>8}{'ns a row':>10}")
    for name, spent in seconds.items():
        print(f"{name:34}{1e3 * spent:8.0f}{1e9 * spent / rows:10.1f}")
    measured = [spent for name, spent in seconds.items() if "(" not in name]
    print(f"{'together':34}{1e3 * sum(measured):8.0f}{1e9 * sum(measured) / rows:10.1f}")
    assembly = compiled_assembly()
    print_instructions(assembly)
    if arguments.loop:
        arguments.loop.write_text("\n".join(loops(assembly)[0]) + "\n")


if __name__ == "__main__":
    main()
