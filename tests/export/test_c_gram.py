"""Gram rows, and changes of the course, counted by exported C are those of the kernel."""

import json
import struct
import zlib
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from subprocess import run
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

import fleet_slip
from fleet_slip.calibration.course_label import PLANE
from fleet_slip.catalog.catalog import load_catalog
from fleet_slip.errors import RefusedError, UsageError
from fleet_slip.export.c_gram import sets_on_board
from fleet_slip.export.files import export_files
from fleet_slip.grams.compute import aggregate
from fleet_slip.grams.on_board import onboard_feature_sets
from fleet_slip.models.registry import ModelVersion
from fleet_slip.regression.gram import Gram
from fleet_slip.resources import SHIPPED_CONFIGS, Configs
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.export.compiled import (
    SANITIZED,
    Counter,
    build,
    can_sanitize,
    compile_c,
    gram_driver,
    learned,
    needs_cc,
    run_compiled,
)
from tests.export.models import MODELS, model_of
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.counted_rows import parse_messages, rows_of_messages, write_counted
from tests.support.course_drives import hostile_drive
from tests.support.logs import land

pytestmark = needs_cc

COUNTED = SIGNALS.gram_signals
MISSING = -(2**15)


def build_counter(folder: Path, *options: str) -> Path:
    """A program that reads drives and writes messages."""
    version = ModelVersion(1, model_of(MODELS["signals"], name="any"), "0" * 64, CATALOG)
    for name, content in export_files(version, None, "c", with_gram=True).items():
        (folder / name).write_bytes(content)
    (folder / "driver.c").write_text(gram_driver("sideslip_any", course=False))
    return compile_c(folder, ["sideslip_any_gram.c", "driver.c"], *options)


@pytest.fixture(scope="module")
def counter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_counter(tmp_path_factory.mktemp("counter"), "-O2")


def count_drives(counter: Path, drives: Sequence[tuple[str, int, Any]]) -> bytes:
    """The messages of drives: a car, when it began, and counts, shape (rows, signals)."""
    data = b""
    for car, start_s, counts in drives:
        rows = np.zeros(len(counts), [("logged", "<i4"), ("counts", "<i2", len(COUNTED))])
        rows["logged"], rows["counts"] = 1, counts
        data += struct.pack("<16sQqQ", car.encode(), start_s, 0, len(rows)) + rows.tobytes()
    return run_compiled([counter], data=data)


def parts_of(content: bytes) -> dict[tuple[str, ...], Gram]:
    """The Grams of the messages of one drive, by signals."""
    parts = {}
    for message in parse_messages(content):
        names = tuple(name for i, name in enumerate(COUNTED) if message.mask >> i & 1)
        numbers = np.frombuffer(message.numbers, "<i8").tolist()
        k = len(names)
        parts[names] = Gram(names, message.rows, tuple(numbers[:k]), tuple(numbers[k:]))
    return parts


def test_each_set_of_signals_has_a_message_and_extremes_are_exact(counter: Path) -> None:
    random = np.random.default_rng(5)
    counts = random.choice([-32767, 32767, 30000, -30000, 0, 1, -1], (5000, len(COUNTED)))
    limits = [(SIGNALS[name].min_count, SIGNALS[name].max_count) for name in COUNTED]
    low, high = (np.array(item) for item in zip(*limits, strict=True))
    counts = np.clip(counts, low, high)
    counts[:1000, 0] = MISSING
    counts[1000:1500, [2, 5]] = MISSING
    counts[1500:1600] = MISSING
    content = count_drives(counter, [("VIN1", 7, counts)])
    parts = parts_of(content)
    assert sum(item.n for item in parts.values()) == 5000
    for names, gram in parts.items():
        at = [COUNTED.index(name) for name in names]
        remaining = [i for i in range(len(COUNTED)) if i not in at]
        mask = np.all(counts[:, at] != MISSING, axis=1)
        mask &= np.all(counts[:, remaining] == MISSING, axis=1)
        assert gram == Gram.from_counts(names, counts[mask][:, at])
    assert len(parts) == 4


def test_rows_of_more_sets_of_signals_are_counted_as_lost(counter: Path) -> None:
    counts = np.zeros((60, len(COUNTED)), np.int16)
    for row in range(60):
        counts[row, row % 6] = MISSING
    messages = parse_messages(count_drives(counter, [("VIN1", 7, counts)]))
    assert [(m.rows, m.lost, m.place, m.parts) for m in messages] == [
        (10, 20, place, 4) for place in range(4)
    ]


def test_the_layout_is_what_the_page_says(counter: Path) -> None:
    counts = np.ones((3, len(COUNTED)), np.int16)
    content = count_drives(counter, [("VIN-17", 1_700_000_000, counts)])
    assert content[:8] == b"FSGR\x01\x00" + len(content).to_bytes(2, "little")
    assert (
        int.from_bytes(content[8:16], "little")
        == next(iter(onboard_feature_sets(CATALOG).values())).definition
    )
    assert content[16:32] == b"VIN-17".ljust(16, b"\0")
    assert content[32:36] == b"\0\0\x01\0"
    assert struct.unpack_from("<QIII", content, 36) == (1_700_000_000, 2**11 - 1, 3, 0)
    assert set(np.frombuffer(content[56:-4], "<i8").tolist()) == {3}
    assert zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], "little")


def test_gram_rows_go_with_c_alone() -> None:
    version = ModelVersion(1, model_of(MODELS["signals"], Fraction(0), "any"), "0" * 64, CATALOG)
    with pytest.raises(UsageError, match="--to c --with-gram"):
        export_files(version, None, "json", with_gram=True)
    names = [*export_files(version, None, "c", with_gram=True)]
    assert {"sideslip_any_gram.h", "sideslip_any_gram.c"} <= {*names}


def test_external_names_of_long_models_differ_in_31_characters(tmp_path: Path) -> None:
    """As C99 and rule 5.1 of MISRA C:2012 ask for; two models, linked into one program."""
    names = [f"waterford_of_summer_with_windows_{end}" for end in ("a", "b")]
    stems = []
    for name in [*names, "short"]:
        version = ModelVersion(1, model_of(MODELS["signals"], name=name), "0" * 64, CATALOG)
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


@pytest.fixture(scope="module")
def of_course(tmp_path_factory: pytest.TempPathFactory) -> Counter:
    return build(tmp_path_factory.mktemp("course"), sets_on_board(CATALOG, learned()), "-O2")


def valid(table: pa.Table) -> pa.Table:
    """A drive whose counts are in the ranges of their signals, as a log's are."""
    for name, signal in SIGNALS.signals.items():
        counts = table[name].cast(pa.int32())
        counts = pc.max_element_wise(counts, signal.min_count, skip_nulls=False)
        counts = pc.min_element_wise(counts, signal.max_count, skip_nulls=False).cast(pa.int16())
        table = table.set_column(table.schema.get_field_index(name), name, counts)
    return table


def grams_of(rows: list[dict[str, Any]], columns: Sequence[str]) -> dict[Any, Gram]:
    """The Gram of each part and set of columns, of some columns alone."""
    grams: dict[Any, Gram] = {}
    for row in rows:
        names = tuple(filter(None, row["signals"].split(",")))
        gram = Gram(names, row["n"], tuple(row["sums"]), tuple(row["products"]))
        restricted = gram.restrict(tuple(name for name in columns if name in names))
        key = row["part"], restricted.signals, row["course_late"] or 0
        grams[key] = grams[key] + restricted if key in grams else restricted
    return grams


def kernel_rows(
    folder: Folder, table: pa.Table, name: str, late: int, configs: Configs = SHIPPED_CONFIGS
) -> list[dict[str, Any]]:
    """Return the Gram rows of `gram --features` for the log."""
    warehouse = Warehouse(folder, configs)
    if not warehouse.logs.snapshot().files:
        land(warehouse, "one", table)
    files = warehouse.logs.snapshot().files
    rows = aggregate(warehouse, files, feature_set=name, delays={"car-1": late})
    if "course_late" not in rows.column_names:
        rows = rows.append_column("course_late", pa.nulls(len(rows), pa.int64()))
    result: list[dict[str, Any]] = rows.to_pylist()
    return result


GRAM_ROWS = """
    SELECT * RENAME (block AS part, row_count AS n, course_delay_quarter_ticks AS course_late)
    FROM grams
"""
"""The view with the names of the table."""


def received_rows(
    root: Path, content: bytes, configs: Configs = SHIPPED_CONFIGS
) -> list[dict[str, Any]]:
    """The Gram rows that the messages of a drive become."""
    root.mkdir()
    fleet = fleet_slip.open(root / "data", configs.folder)
    fleet.import_onboard_grams(
        write_counted(root / "rows", rows_of_messages(content, fleet.warehouse.catalog))
    )
    result: list[dict[str, Any]] = fleet.sql(GRAM_ROWS).to_arrow_table().to_pylist()
    return result


LONG_CASES = (
    pytest.param(*parameters, marks=pytest.mark.long)
    for parameters in ((-11, 5), (1, 1), (200, 20))
)


@pytest.mark.parametrize(("late", "fix_ticks"), [(0, 10), (-40, 10), *LONG_CASES])
def test_received_rows_are_those_of_the_log(
    tmp_path: Path, of_course: Counter, late: int, fix_ticks: int
) -> None:
    """With fixes that fail, holes, missing values, standing cars and a course that goes round."""
    table = valid(hostile_drive("a", 5000, 7, fix_ticks=fix_ticks))
    came = received_rows(tmp_path / "cars", of_course.messages(table, late))
    logs = LocalFolder(tmp_path / "logs")
    for counted_set in of_course.sets:
        delay = late if counted_set.counted.in_time else 0
        received = [row for row in came if row["feature_set"] == counted_set.counted.identity]
        expected = grams_of(
            kernel_rows(logs, table, counted_set.counted.name, delay), counted_set.columns
        )
        if counted_set.complete:
            expected = {
                k: v for k, v in expected.items() if len(k[1]) in (0, len(counted_set.columns))
            }
        assert grams_of(received, counted_set.columns) == expected, counted_set.counted.name
        changes = [
            gram for (_, names, _), gram in expected.items() if names and counted_set.counted.times
        ]
        assert bool(changes) == bool(counted_set.counted.times)
        assert not changes or sum(gram.n for gram in changes) > 20


THREE = """
[sets.few]
description = "few"
signals = ["ax", "ay", "yaw_rate"]
windows = {windows}

[sets.three]
description = "three"
of = "few"
features = ["curvature"]
change_s = [3.5, 4, 5]
"""


def test_several_times_are_parts_of_the_drive(tmp_path: Path) -> None:
    """A set of changes over several times, with a gate."""
    windows = ["ay_mean_16", *PLANE, CATALOG.members("cornering")[0]]
    configs = Configs(tmp_path)
    (tmp_path / "features.toml").write_text(THREE.format(windows=json.dumps(windows)))
    catalog = load_catalog(configs)
    sets = sets_on_board(catalog, learned(("ay_mean_16",), "three", catalog))[:2]
    counted = build(tmp_path, sets)
    table = valid(hostile_drive("a", 5000, 3))
    came = received_rows(tmp_path / "cars", counted.messages(table, 9), configs)
    received = [row for row in came if row["feature_set"] == catalog.identity("three")]
    assert {row["part"] for row in received} == {"3.5 s", "4 s", "5 s"}
    expected = kernel_rows(LocalFolder(tmp_path / "logs"), table, "three", 9, configs)
    assert grams_of(received, sets[1].columns) == grams_of(expected, sets[1].columns)


def test_nothing_overflows(tmp_path: Path, of_course: Counter) -> None:
    """Not with counts beyond all ranges, and delays that no receiver has."""
    if not can_sanitize():
        pytest.skip("the compiler's sanitizers are not here")
    sanitized = build(tmp_path, of_course.sets, *SANITIZED)
    rows, width = 3000, 1 + len(of_course.signals)
    random = np.random.default_rng(1)
    samples = random.integers(-(2**31), 2**31, (rows, width)).astype(np.int32)
    samples[500:] //= 2**16
    samples[:, 0] = random.random(rows) < 0.99
    for late in (-(2**31), 2**31 - 1, 7):
        data = struct.pack("<16sQqQ", b"VIN", 2**64 - 1, late, rows) + samples.tobytes()
        assert run_compiled([sanitized.program], data=data)


def test_sets_with_unknown_constants_are_not_counted() -> None:
    with pytest.raises(RefusedError, match="has ay_mean_16_mass: cars count up to 32 columns"):
        sets_on_board(CATALOG, learned(("ay_mean_16_mass",), "course_fleet"))
    many = CATALOG.feature_set("course").windows[:30]
    with pytest.raises(RefusedError, match="up to 32 columns"):
        sets_on_board(CATALOG, learned(many))
