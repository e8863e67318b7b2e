"""How long a selection takes from the table of Gram rows, by the plan that the command line runs.

    python -m benchmarks.selection [DRIVES]

The synthetic fleet of `benchmarks.statistics`, one Gram row a drive, in a table like the job's.
"""

import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

import numpy as np
import pyarrow as pa

from benchmarks.statistics import Fleet, simulate
from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.delta import Change
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.selection.answer import answer_request
from fleet_slip.selection.request import SelectionRequest
from fleet_slip.warehouse.tables import Warehouse

DRIVES_PER_FILE = 500

PLANS = {
    "Table I": SelectionRequest(),
    "backward order, BIC by drives, choice in every fold": SelectionRequest(
        rank="backward", criterion="bic"
    ),
    "the same, 1,000 bootstraps, 100 repeats": SelectionRequest(
        rank="backward", criterion="bic", bootstrap=1000, repeat=100
    ),
    "all subsets, 1,000 bootstraps": SelectionRequest(all_subsets=True, bootstrap=1000),
}


def fill(warehouse: Warehouse, fleet: Fleet) -> None:
    names = catalogue().gram_signals
    inputs = fleet.table.signals[: len(names) - 1]
    table = fleet.table.restrict([*inputs, fleet.table.signals[-1]])
    drives = len(table)
    known = {
        "feature_set": ["signals"] * drives,
        "file": [f"day=2024-01-01/{i // DRIVES_PER_FILE}.parquet" for i in range(drives)],
        "day": [date(2024, 1, 1)] * drives,
        "drive_id": fleet.ids,
        "vehicle_id": [f"car-{i % 300}" for i in range(drives)],
        "source": ["simulated"] * drives,
        "signals": [",".join(names)] * drives,
        "n": table.n,
        "clipped": np.zeros(drives, dtype=np.int64),
        "sums": _lists(table.sums),
        "products": _lists(table.products),
    }
    schema = warehouse.grams.schema
    rows = pa.table(
        {
            field.name: pa.array(known[field.name], field.type)
            if field.name in known and not isinstance(known[field.name], pa.Array)
            else known.get(field.name, pa.nulls(drives, field.type))
            for field in schema
        }
    ).cast(schema)
    action = warehouse.grams.write_file("signals-synthetic", rows)
    warehouse.grams.snapshot().commit(Change(add=[action]))


def _lists(values: IntArray) -> pa.Array:
    drives, width = values.shape
    offsets = np.arange(0, (drives + 1) * width, width, dtype=np.int32)
    return pa.ListArray.from_arrays(offsets, pa.array(values.ravel()))


def timed(name: str, warehouse: Warehouse, plan: SelectionRequest) -> None:
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        answer_request(warehouse, plan)
        best = min(best, time.perf_counter() - start)
    print(f"{name:<58} {best * 1000:8.0f} ms", flush=True)


def main() -> None:
    drives = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000
    with tempfile.TemporaryDirectory() as folder:
        warehouse = Warehouse(LocalFolder(Path(folder)))
        fill(warehouse, simulate(drives))
        print(f"{drives} Gram rows")
        for name, plan in PLANS.items():
            timed(name, warehouse, plan)
        command = [str(Path(sys.executable).with_name("fleet-slip")), "--root", folder, "select"]
        start = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        print(
            f"{'fleet-slip select, the process':<58} {(time.perf_counter() - start) * 1000:8.0f} ms"
        )


if __name__ == "__main__":
    main()
