"""Exported C, compiled by the system's compiler, and driven with counts."""

import resource
import shutil
import struct
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalog.catalog import Catalog
from fleet_slip.export.c import c_header, c_source, count_costs
from fleet_slip.export.c_gram import OnBoard, c_gram_header, c_gram_source, lower
from fleet_slip.export.program import Program
from fleet_slip.export.stepping import Sample
from fleet_slip.export.templating import c_prefix, field_names
from fleet_slip.models.manifest import LearnedFrom, Manifest, ModelTerm
from fleet_slip.models.registry import ModelVersion
from tests.export.cars import Car
from tests.export.models import MODELS, model_of
from tests.support.catalog import CATALOG

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
    words: Sequence[str | Path], folder: Path | None = None, data: bytes = b""
) -> bytes:
    """Run a compiled program; return what it says."""
    done = subprocess.run(
        words,
        cwd=folder,
        input=data,
        capture_output=True,
        check=False,
        timeout=300,
        preexec_fn=_allow_all_data,
    )
    assert done.returncode == 0, done.stderr.decode(errors="replace")[-3000:]
    return done.stdout


@cache
def can_sanitize() -> bool:
    """Return True if the compiler has the sanitizers, and a program with them runs here."""
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
    constants = [*car.fact_counts(program), *car.number_counts(program)]
    message = struct.pack(
        f"{len(constants)}i", *(NO_ANGLE if count is None else count for count in constants)
    )
    width = len(field_names(program)["signals"])
    counts = [-(2**15) if count is None else count for sample in samples for count in sample]
    message += struct.pack(f"{width * len(samples)}h", *counts)
    angles = struct.unpack(f"{len(samples)}i", run_compiled([driver], data=message))
    return [None if count == NO_ANGLE else count for count in angles]


MISSING = -(2**31)
START_S = 1_714_557_600
COLUMNS = ("steering_mean_16", "ay_mean_16", "ay_square_mean_8", "yaw_rate_speed_mean_8")
GRAM_DRIVER = """
#include <stdio.h>
#include "PREFIX_gram.h"

int main(void)
{
    static PREFIX_gram gram;
    static uint8_t message[UPPER_GRAM_LONGEST_MESSAGE];
    struct { uint8_t vehicle[16]; uint64_t start_s; int64_t late; uint64_t ticks; } drive;
    while (fread(&drive, sizeof drive, 1U, stdin) == 1U) {
        PREFIX_gram_start(&gramLATE);
        for (uint64_t i = 0U; i < drive.ticks; i++) {
            int32_t logged;
            PREFIX_gram_sample sample;
            if (fread(&logged, sizeof logged, 1U, stdin) != 1U) { return 1; }
            if (fread(&sample, sizeof sample, 1U, stdin) != 1U) { return 1; }
            if (logged != 0) { PREFIX_gram_add(&gram, &sample); }
            PASS
        }
        uint32_t size = 0U;
        uint32_t part = 0U;
        do {
            size = PREFIX_gram_message(&gram, part, drive.vehicle, drive.start_s, message);
            (void)fwrite(message, 1U, size, stdout);
            part++;
        } while (size > 0U);
    }
    return 0;
}
"""


def gram_driver(prefix: str, *, course: bool = True) -> str:
    """A program that reads drives, each tick after whether it was logged, and writes messages."""
    text = GRAM_DRIVER.replace("UPPER", prefix.upper()).replace(
        "LATE", ", (int32_t)drive.late" * course
    )
    passed = "if (logged == 0) { PREFIX_gram_pass(&gram); }" if course else ""
    return text.replace("PASS", passed).replace("UPPER", prefix.upper()).replace("PREFIX", prefix)


def learned(
    columns: Sequence[str] = COLUMNS, feature_set: str = "course", catalog: Catalog = CATALOG
) -> Manifest:
    """A model that changes of the course taught."""
    terms = tuple(
        ModelTerm(
            signal=name,
            column=name,
            unit="1",
            scale=Decimal("0.001"),
            definition=catalog.definition(name),
            coefficient=0.5,
            coefficient_exact=Fraction(1, 2),
        )
        for name in columns
    )
    manifest = model_of(MODELS["signals"], name="any")
    trained = manifest.trained_on.model_copy(update={"feature_set": catalog.identity(feature_set)})
    source = LearnedFrom(
        label="course",
        change_s=4.0,
        cars=1,
        intercept_uncertainty_deg=0.01,
        intercept_spread_deg=0.0,
    )
    return manifest.model_copy(
        update={"terms": terms, "trained_on": trained, "learned_from": source}
    )


@dataclass
class Counter:
    """A compiled counter, and what it counts."""

    program: Path
    sets: tuple[OnBoard, ...]

    @property
    def signals(self) -> tuple[str, ...]:
        return tuple(signal.name for signal in lower(CATALOG, self.sets)[0].signals)

    def messages(self, table: pa.Table, late: int = 0, start_s: int = START_S) -> bytes:
        """Return the messages that a car sends for a drive with these rows."""
        ticks = table["tick"].to_numpy()
        samples = np.full((ticks[-1] + 1, 1 + len(self.signals)), MISSING, np.int32)
        samples[:, 0] = 0
        samples[ticks, 0] = 1
        for place, name in enumerate(self.signals):
            samples[ticks, 1 + place] = table[name].cast(pa.int32()).fill_null(MISSING).to_numpy()
        car = table["vehicle_id"][0].as_py()
        head = struct.pack("<16sQqQ", car.encode(), start_s, late, len(samples))
        content = head + samples.tobytes()
        return run_compiled([self.program], data=content)


def write_counter(folder: Path, sets: tuple[OnBoard, ...]) -> None:
    """Write the C that counts some feature sets."""
    (folder / "any_gram.h").write_text(c_gram_header(CATALOG, "any", sets))
    (folder / "any_gram.c").write_text(c_gram_source(CATALOG, "any", sets))


def build(folder: Path, sets: tuple[OnBoard, ...], *options: str) -> Counter:
    """Compile what counts some feature sets."""
    write_counter(folder, sets)
    (folder / "driver.c").write_text(gram_driver("any"))
    return Counter(compile_c(folder, ["any_gram.c", "driver.c"], *options), sets)
