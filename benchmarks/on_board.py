"""The cost of a published version on board: its exported C on this machine, and the same in Python.

    python -m benchmarks.on_board ROOT MODEL... [--seconds 2]

For each model: time of a C step over a drive of the logs (gcc -O2; the best of some rounds), bytes
of its state, of its code and of its constants (-Os), of the stack of a step, time of a step of
`fleet.estimator`, and samples a second of `predict`. Needs `cc` and `size`. With
`arm-none-eabi-gcc` and `qemu-system-arm`, also what it costs on a Cortex-M4.
"""

import argparse
import json
import re
import struct
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import fleet_slip
from fleet_slip.export.c import c_header, c_source
from fleet_slip.export.files import export_files
from fleet_slip.export.stepping import compile_program
from fleet_slip.export.templating import c_prefix
from fleet_slip.models.registry import ModelVersion
from tests.support.catalog import CATALOG
from tests.support.cortex_m import can_measure, measure_cortex_m

DRIVER = """
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include "PREFIX.h"

static PREFIX_sample samples[ROWS];
static PREFIX_state state;

int main(void)
{
    double best = 1e9;
    int64_t total = 0;
    if (fread(samples, sizeof samples[0], ROWS, stdin) != ROWS) { return 1; }
    for (int round = 0; round < ROUNDS; round++) {
        struct timespec from, to;
        START
        (void)clock_gettime(CLOCK_MONOTONIC, &from);
        for (int i = 0; i < ROWS; i++) {
            int32_t angle;
            if (PREFIX_step(&state, &samples[i], &angle)) { total += angle; }
        }
        (void)clock_gettime(CLOCK_MONOTONIC, &to);
        double ns = 1e9 * (double)(to.tv_sec - from.tv_sec);
        ns += (double)(to.tv_nsec - from.tv_nsec);
        if (ns / ROWS < best) { best = ns / ROWS; }
    }
    printf("%f %lu %lld\\n", best, (unsigned long)sizeof(PREFIX_state), (long long)total);
    return 0;
}
"""
UNKNOWN = "PREFIX_car car = { CAR }; PREFIX_start(&state, &car);"
ROUNDS = 200


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("models", nargs="+")
    parser.add_argument("--seconds", type=float, default=2.0)
    arguments = parser.parse_args()
    fleet = fleet_slip.open(arguments.root)
    print(
        json.dumps(
            [measure(fleet, fleet.models.get(m), arguments.seconds) for m in arguments.models],
            indent=2,
        )
    )


def measure(fleet: fleet_slip.Fleet, version: ModelVersion, seconds: float) -> dict[str, Any]:
    """Return the figures of one version, over the first drive of the logs."""
    drive = fleet.sql(
        "SELECT * FROM log WHERE drive_id = (SELECT min(drive_id) FROM log) ORDER BY tick"
    ).pl()
    with tempfile.TemporaryDirectory() as folder:
        board = in_c(Path(folder), fleet, version)
        if can_measure():
            files = export_files(version, fleet.warehouse, "c")
            texts = {name: content.decode() for name, content in files.items()}
            board["cortex_m4"] = measure_cortex_m(Path(folder), c_prefix(version), texts)
    estimator = fleet.models.estimator(version)
    rows = drive.select(estimator.columns).to_dicts()
    estimator.step(rows[0])
    steps = best_of(lambda: [estimator.step(row) for row in rows], seconds) / len(rows)
    version.predict(drive)
    drive_s = best_of(lambda: version.predict(drive), seconds) / len(rows)
    return {
        "model": version.reference,
        "terms": len(version.manifest.terms),
        **board,
        "python_step_us": round(1e6 * steps, 2),
        "predict_samples_per_s": round(1 / drive_s),
    }


def best_of(call: Any, seconds: float) -> float:
    """Return the shortest time of a call, in s."""
    best, until = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < until:
        began = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - began)
    return best


def in_c(folder: Path, fleet: fleet_slip.Fleet, version: ModelVersion) -> dict[str, Any]:
    """Compile a version and run it; return its time and sizes."""
    program, prefix = compile_program(CATALOG, version.manifest), c_prefix(version)
    names = ", ".join(signal.name for signal in program.signals)
    counts = fleet.sql(
        f"SELECT {names} FROM log_counts "
        "WHERE drive_id = (SELECT min(drive_id) FROM log_counts) ORDER BY tick"
    ).fetchall()
    constants = len(program.facts) + len(program.numbers)
    start = UNKNOWN.replace("CAR", ", ".join(["INT32_MIN"] * constants)) if constants else ""
    driver = DRIVER.replace("START", start or "PREFIX_start(&state);")
    for word, value in (("PREFIX", prefix), ("ROWS", len(counts)), ("ROUNDS", ROUNDS)):
        driver = driver.replace(word, str(value))
    (folder / f"{prefix}.h").write_text(c_header(version, program))
    (folder / f"{prefix}.c").write_text(c_source(version, program))
    (folder / "driver.c").write_text(driver)
    run(folder, "cc", "-std=c99", "-O2", f"{prefix}.c", "driver.c", "-o", "driver")
    values = [-(2**15) if signal is None else signal for row in counts for signal in row]
    output = run(folder, "./driver", data=struct.pack(f"{len(values)}h", *values)).split()
    run(folder, "cc", "-std=c99", "-Os", "-fstack-usage", "-c", f"{prefix}.c")
    sections = run(folder, "size", "-A", f"{prefix}.o")
    sizes = {name: int(size) for name, size in re.findall(r"^(\.\w+)\S*\s+(\d+)", sections, re.M)}
    stack = max(int(line.split()[1]) for line in (folder / f"{prefix}.su").read_text().splitlines())
    return {
        "c_step_ns": round(float(output[0]), 1),
        "state_bytes": int(output[1]),
        "code_bytes": sizes.get(".text", 0),
        "constant_bytes": sizes.get(".rodata", 0),
        "stack_bytes": stack,
    }


def run(folder: Path, *words: str, data: bytes | None = None) -> str:
    done = subprocess.run(
        words, cwd=folder, input=data, capture_output=True, check=True, timeout=120
    )
    return done.stdout.decode()


if __name__ == "__main__":
    main()
