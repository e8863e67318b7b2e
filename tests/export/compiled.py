"""Exported C, compiled by the system's compiler, and driven with counts."""

import resource
import shutil
import struct
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from fleet_slip.export.c import c_header, c_source
from fleet_slip.export.compile import Sample
from fleet_slip.export.costs import count_costs
from fleet_slip.export.program import Car, Program
from fleet_slip.export.templating import c_prefix, field_names
from fleet_slip.models.registry import ModelVersion

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror")
SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
DEADLINE_S = 400

needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc")

NO_ANGLE = -(2**31)

DRIVER = """
#include <stdio.h>
#include "PREFIX.h"

extern char as_counted[(sizeof(PREFIX_state) == BYTES) ? 1 : -1];

int main(void)
{
    static PREFIX_state state;
    PREFIX_sample sample;
    int32_t angle;
CAR
    for (uint32_t tick = 0U; fread(&sample, sizeof sample, 1U, stdin) == 1U; tick++) {
BEFORE
        if (!PREFIX_step(&state, &sample, &angle)) { angle = INT32_MIN; }
        (void)fwrite(&angle, sizeof angle, 1U, stdout);
    }
    return 0;
}
"""

GIVEN = """    PREFIX_car car;
    if (fread(&car, sizeof car, 1U, stdin) != 1U) { return 1; }
    PREFIX_start(&state, &car);"""


def compile_c(folder: Path, files: Sequence[str], *options: str) -> Path:
    """Compile files of a folder without a warning; return the program."""
    words = ["cc", *STRICT, *options, *files, "-o", "program"]
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, check=False, timeout=DEADLINE_S
    )
    assert done.returncode == 0, done.stderr[:3000]
    return folder / "program"


def _allow_all_data() -> None:
    """Take back the limit that a query in this process has set, which programs would inherit.

    AddressSanitizer maps 14 TiB of shadow memory before main begins, which counts as data.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))


def run_compiled(
    words: Sequence[str | Path], folder: Path | None = None, given: bytes = b""
) -> bytes:
    """Run a compiled program; return what it says."""
    done = subprocess.run(
        words,
        cwd=folder,
        input=given,
        capture_output=True,
        check=False,
        timeout=300,
        preexec_fn=_allow_all_data,
    )
    assert done.returncode == 0, done.stderr.decode(errors="replace")[-3000:]
    return done.stdout


@cache
def can_sanitize() -> bool:
    """Whether the compiler has the sanitizers, and a program with them runs here."""
    with TemporaryDirectory() as folder:
        Path(folder, "empty.c").write_text("int main(void) { return 0; }\n")
        try:
            run_compiled([compile_c(Path(folder), ["empty.c"], *SANITIZED)])
        except AssertionError:
            return False
    return True


def build_driver(
    folder: Path, version: ModelVersion, program: Program, *options: str, before: str = ""
) -> Path:
    """Return a program that reads a car and samples, and writes angles; `before` each tick.

    It compiles if the state is as large as `count_costs` says.
    """
    prefix = c_prefix(version)
    has_car = bool(program.facts or program.numbers)
    car = GIVEN if has_car else "    PREFIX_start(&state);"
    driver = DRIVER.replace("BYTES", str(count_costs(program).memory_bytes))
    driver = driver.replace("CAR", car).replace("BEFORE", before).replace("PREFIX", prefix)
    (folder / f"{prefix}.h").write_text(c_header(version, program))
    (folder / f"{prefix}.c").write_text(c_source(version, program))
    (folder / "driver.c").write_text(driver)
    return compile_c(folder, [f"{prefix}.c", "driver.c"], *options)


def drive(driver: Path, program: Program, car: Car, samples: Sequence[Sample]) -> list[int | None]:
    """Return the angles that a driver writes."""
    known = [*car.fact_counts(program), *car.number_counts(program)]
    given = struct.pack(f"{len(known)}i", *(NO_ANGLE if one is None else one for one in known))
    width = len(field_names(program)["signals"])
    counts = [-(2**15) if one is None else one for sample in samples for one in sample]
    given += struct.pack(f"{width * len(samples)}h", *counts)
    angles = struct.unpack(f"{len(samples)}i", run_compiled([driver], given=given))
    return [None if one == NO_ANGLE else one for one in angles]
