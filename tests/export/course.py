"""Exported C that counts changes of the course, compiled, and driven with logs."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pyarrow as pa

from fleet_slip.catalogue.features import features
from fleet_slip.export.c_gram import OnBoard, c_gram_header, c_gram_source, lower
from fleet_slip.models.manifest import LearnedFrom, Manifest, ModelTerm
from tests.export.compiled import compile_c, run_compiled
from tests.export.models import MODELS, model_of

MISSING = -(2**31)
START_S = 1_714_557_600
COLUMNS = ("steering_mean_16", "ay_mean_16", "ay_square_mean_8", "yaw_rate_speed_mean_8")
DRIVER = """
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
    text = DRIVER.replace("UPPER", prefix.upper()).replace("LATE", ", (int32_t)drive.late" * course)
    passed = "if (logged == 0) { PREFIX_gram_pass(&gram); }" if course else ""
    return text.replace("PASS", passed).replace("PREFIX", prefix)


def learned(columns: Sequence[str] = COLUMNS, feature_set: str = "course") -> Manifest:
    """A model that changes of the course taught."""
    terms = tuple(
        ModelTerm(
            signal=name,
            column=name,
            unit="1",
            scale=Decimal("0.001"),
            definition=features().definition(name),
            coefficient=0.5,
            coefficient_exact=Fraction(1, 2),
        )
        for name in columns
    )
    one = model_of(MODELS["signals"], name="any")
    trained = one.trained_on.model_copy(update={"feature_set": features().identity(feature_set)})
    said = LearnedFrom(
        label="course",
        change_s=4.0,
        cars=1,
        intercept_uncertainty_deg=0.01,
        intercept_spread_deg=0.0,
    )
    return one.model_copy(update={"terms": terms, "trained_on": trained, "learned_from": said})


@dataclass
class Counter:
    """A compiled counter, and what it counts."""

    program: Path
    sets: tuple[OnBoard, ...]

    @property
    def signals(self) -> tuple[str, ...]:
        return tuple(one.name for one in lower(self.sets)[0].signals)

    def messages(self, table: pa.Table, late: int = 0, start_s: int = START_S) -> bytes:
        """What a car sends of a drive whose log is that table."""
        ticks = table["tick"].to_numpy()
        samples = np.full((ticks[-1] + 1, 1 + len(self.signals)), MISSING, np.int32)
        samples[:, 0] = 0
        samples[ticks, 0] = 1
        for place, name in enumerate(self.signals):
            samples[ticks, 1 + place] = table[name].cast(pa.int32()).fill_null(MISSING).to_numpy()
        car = table["vehicle_id"][0].as_py()
        head = struct.pack("<16sQqQ", car.encode(), start_s, late, len(samples))
        given = head + samples.tobytes()
        return run_compiled([self.program], given=given)


def write_counter(folder: Path, sets: tuple[OnBoard, ...]) -> None:
    """Write the C that counts some feature sets."""
    (folder / "any_gram.h").write_text(c_gram_header("any", sets))
    (folder / "any_gram.c").write_text(c_gram_source("any", sets))


def build(folder: Path, sets: tuple[OnBoard, ...], *options: str) -> Counter:
    """Compile what counts some feature sets."""
    write_counter(folder, sets)
    (folder / "driver.c").write_text(gram_driver("any"))
    return Counter(compile_c(folder, ["any_gram.c", "driver.c"], *options), sets)
