"""Gram rows counted by exported C are those of the warehouse's job, bit for bit."""

import struct
import zlib
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from subprocess import run
from typing import Any

import numpy as np
import pytest

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import UsageError
from fleet_slip.export.files import export_files
from fleet_slip.grams.on_board import counted_sets
from fleet_slip.models.registry import ModelVersion
from fleet_slip.regression.gram import Gram
from tests.export.compiled import compile_c, needs_cc, run_compiled
from tests.export.course import gram_driver
from tests.export.models import MODELS, model_of
from tests.support.counted_rows import parse_messages

pytestmark = needs_cc

SIGNALS = catalogue().gram_signals
MISSING = -(2**15)


def build_counter(folder: Path, *options: str) -> Path:
    """A program that reads drives and writes messages."""
    version = ModelVersion(1, model_of(MODELS["signals"], name="any"), "0" * 64)
    for name, content in export_files(version, None, "c", with_gram=True).items():
        (folder / name).write_bytes(content)
    (folder / "driver.c").write_text(gram_driver("sideslip_any", course=False))
    return compile_c(folder, ["sideslip_any_gram.c", "driver.c"], *options)


@pytest.fixture(scope="module")
def counter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_counter(tmp_path_factory.mktemp("counter"), "-O2")


def count_drives(counter: Path, drives: Sequence[tuple[str, int, Any]]) -> bytes:
    """The messages of drives: a car, when it began, and counts, shape (rows, signals)."""
    given = b""
    for car, start_s, counts in drives:
        rows = np.zeros(len(counts), [("logged", "<i4"), ("counts", "<i2", len(SIGNALS))])
        rows["logged"], rows["counts"] = 1, counts
        given += struct.pack("<16sQqQ", car.encode(), start_s, 0, len(rows)) + rows.tobytes()
    return run_compiled([counter], given=given)


def parts_of(content: bytes) -> dict[tuple[str, ...], Gram]:
    """The Grams of the messages of one drive, by signals."""
    found = {}
    for message in parse_messages(content):
        names = tuple(name for i, name in enumerate(SIGNALS) if message.mask >> i & 1)
        numbers = np.frombuffer(message.numbers, "<i8").tolist()
        k = len(names)
        found[names] = Gram(names, message.rows, tuple(numbers[:k]), tuple(numbers[k:]))
    return found


def test_each_set_of_signals_has_a_message_and_extremes_are_exact(counter: Path) -> None:
    random = np.random.default_rng(5)
    counts = random.choice([-32767, 32767, 30000, -30000, 0, 1, -1], (5000, len(SIGNALS)))
    limits = [(catalogue()[name].min_count, catalogue()[name].max_count) for name in SIGNALS]
    low, high = (np.array(one) for one in zip(*limits, strict=True))
    counts = np.clip(counts, low, high)
    counts[:1000, 0] = MISSING
    counts[1000:1500, [2, 5]] = MISSING
    counts[1500:1600] = MISSING
    content = count_drives(counter, [("VIN1", 7, counts)])
    found = parts_of(content)
    assert sum(one.n for one in found.values()) == 5000
    for names, gram in found.items():
        at = [SIGNALS.index(name) for name in names]
        others = [i for i in range(len(SIGNALS)) if i not in at]
        mine = np.all(counts[:, at] != MISSING, axis=1)
        mine &= np.all(counts[:, others] == MISSING, axis=1)
        assert gram == Gram.from_counts(names, counts[mine][:, at])
    assert len(found) == 4


def test_rows_of_more_sets_of_signals_are_counted_as_lost(counter: Path) -> None:
    counts = np.zeros((60, len(SIGNALS)), np.int16)
    for row in range(60):
        counts[row, row % 6] = MISSING
    messages = parse_messages(count_drives(counter, [("VIN1", 7, counts)]))
    assert [(m.rows, m.lost, m.place, m.parts) for m in messages] == [
        (10, 20, place, 4) for place in range(4)
    ]


def test_the_layout_is_what_the_page_says(counter: Path) -> None:
    counts = np.ones((3, len(SIGNALS)), np.int16)
    content = count_drives(counter, [("VIN-17", 1_700_000_000, counts)])
    assert content[:8] == b"FSGR\x01\x00" + len(content).to_bytes(2, "little")
    assert int.from_bytes(content[8:16], "little") == next(iter(counted_sets().values())).definition
    assert content[16:32] == b"VIN-17".ljust(16, b"\0")
    assert content[32:36] == b"\0\0\x01\0"
    assert struct.unpack_from("<QIII", content, 36) == (1_700_000_000, 2**11 - 1, 3, 0)
    assert set(np.frombuffer(content[56:-4], "<i8").tolist()) == {3}
    assert zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")


def test_gram_rows_go_with_c_alone() -> None:
    version = ModelVersion(1, model_of(MODELS["signals"], Fraction(0), "any"), "0" * 64)
    with pytest.raises(UsageError, match="--to c --with-gram"):
        export_files(version, None, "json", with_gram=True)
    names = [*export_files(version, None, "c", with_gram=True)]
    assert {"sideslip_any_gram.h", "sideslip_any_gram.c"} <= {*names}


def test_external_names_of_long_models_differ_in_31_characters(tmp_path: Path) -> None:
    """As C99 and rule 5.1 of MISRA C:2012 ask for; two models, linked into one program."""
    names = [f"waterford_of_summer_with_windows_{end}" for end in ("a", "b")]
    stems = []
    for name in [*names, "short"]:
        version = ModelVersion(1, model_of(MODELS["signals"], name=name), "0" * 64)
        files = export_files(version, None, "c", with_gram=True)
        for file, content in files.items():
            (tmp_path / file).write_bytes(content)
        (stem,) = {file.removesuffix("_gram.c") for file in files if file.endswith("_gram.c")}
        stems += [stem, f"{stem}_gram"]
    assert stems[-2] == "sideslip_short"
    (tmp_path / "main.c").write_text("int main(void) { return 0; }\n")
    program = compile_c(tmp_path, [*(f"{stem}.c" for stem in stems), "main.c"])
    listed = run(
        ["nm", "--defined-only", "--extern-only", program],
        capture_output=True,
        text=True,
        check=True,
    )
    symbols = [line.split()[-1] for line in listed.stdout.splitlines() if "sideslip_" in line]
    assert len(symbols) == 3 * 5
    assert len({symbol[:31] for symbol in symbols}) == len(symbols)
