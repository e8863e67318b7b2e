"""Exported C, compiled without a warning and run under sanitizers, computes what `score` does."""

import re
import shutil
import subprocess
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.export.stepping import Estimator, angles_by_kernel, compile_program
from fleet_slip.models.registry import ModelVersion
from tests.export.compiled import (
    DEADLINE_S,
    SANITIZED,
    build_driver,
    can_sanitize,
    compile_c,
    drive,
    needs_cc,
    run_compiled,
)
from tests.export.models import (
    BLENDS,
    CARS,
    MODELS,
    SMALL,
    export_texts,
    hostile_drive,
    model_of,
    version_of,
)
from tests.support.catalog import CATALOG, SIGNALS

pytestmark = needs_cc


@pytest.mark.parametrize("name", [*MODELS, *BLENDS])
def test_hostile_drives_give_the_angles_of_the_kernel(name: str, tmp_path: Path) -> None:
    """And nothing overflows or reads beyond its memory, where the compiler has sanitizers."""
    version = version_of(name)
    manifest, program = version.manifest, compile_program(CATALOG, version.manifest)
    options = SANITIZED if can_sanitize() else ("-O2",)
    driver = build_driver(tmp_path, version, program, *options)
    angles: set[int | None] = set()
    for seed, car in enumerate(CARS):
        samples = hostile_drive(program, 400, seed)
        computed = drive(driver, program, car, samples)
        assert computed == angles_by_kernel(
            SIGNALS, manifest, program, car.facts, car.numbers, samples
        )
        angles |= {*computed}
    assert len(angles) > 10
    assert None in angles


def test_the_next_drive_remembers_what_was_learned(tmp_path: Path) -> None:
    """All of 256 parts, some, none: as the estimator in Python does, in counts of a column."""
    manifest = model_of({"slope": Fraction(1, 3), "ever": Fraction(1, 7)}, name="any")
    program, version = (
        compile_program(CATALOG, manifest),
        ModelVersion(1, manifest, "0" * 64, CATALOG),
    )
    samples = hostile_drive(program, 300, 5)
    after: dict[int, list[int | None]] = {}
    for retained in (0, 77, 256, 1000):
        again = f"if (tick == 200U) {{ PREFIX_next(&state, {retained}U); }}"
        driver = build_driver(tmp_path, version, program, before=again)
        after[retained] = drive(driver, program, CARS[0], samples)[200:]
        estimator = Estimator(CATALOG, manifest)
        columns = [signal.column for signal in program.signals]
        scales = [float(signal.scale) for signal in program.signals]
        stepped = []
        for tick, sample in enumerate(samples):
            if tick == 200:
                estimator.restart(min(retained, 256))
            values = [None if n is None else n * s for n, s in zip(sample, scales, strict=True)]
            stepped.append(estimator.step(dict(zip(columns, values, strict=True))))
        expected = [None if x is None else x / float(program.angle.scale) for x in stepped[200:]]
        for computed, angle in zip(after[retained], expected, strict=True):
            assert (computed is None) == (angle is None)
            assert computed is None or angle is None or abs(computed - angle) <= 1
    assert after[0] == drive(driver, program, CARS[0], samples[200:])
    assert after[256] == after[1000] != after[77] != after[0]


FUZZ = """
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int main(void)
{
    static uint8_t data[100000];
    return LLVMFuzzerTestOneInput(data, fread(data, 1U, sizeof data, stdin));
}
"""


def test_no_bytes_make_the_fuzz_target_overflow(tmp_path: Path) -> None:
    """With bytes from numpy; with clang, libFuzzer calls the same target."""
    if not can_sanitize():
        pytest.skip("the compiler's sanitizers are not here")
    manifest = model_of(MODELS["every_kind"], Fraction(5), "any")
    files = export_texts(ModelVersion(1, manifest, "0" * 64, CATALOG), None, "c")
    for name, text in {**files, "main.c": FUZZ}.items():
        (tmp_path / name).write_text(text)
    sources = ["sideslip_any.c", "sideslip_any_fuzz.c", "main.c"]
    target = compile_c(tmp_path, sources, *SANITIZED)
    for seed, size in enumerate((0, 5, 19, 100_000, 99_999)):
        data = np.random.default_rng(seed).bytes(size)
        run_compiled([target], data=data)


def test_the_self_test_passes_and_notices_another_angle(smoke_root: Path, tmp_path: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    files = export_texts(fleet.models.get("smoke"), fleet.warehouse, "c")
    ends = (".h", ".c", "_test.c", "_fuzz.c", ".a2l", "_c_README.md", "_c_manifest.json")
    assert list(files) == [f"sideslip_smoke{end}" for end in ends]
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    sources = ["sideslip_smoke.c", "sideslip_smoke_test.c"]
    assert result_of(compile_c(tmp_path, sources)) == (0, "smoke@1: 0 of 900 angles are wrong\n")
    text = files["sideslip_smoke.c"]
    (tmp_path / "sideslip_smoke.c").write_text(
        text.replace("high += (int64_t)", "high -= (int64_t)")
    )
    code, printed = result_of(compile_c(tmp_path, sources))
    assert code == 1
    assert "0 of 900" not in printed.removeprefix("smoke@1: 900")


COUNTING = """
#include <cstdio>
#include "sideslip_smoke.h"
int main() {
    sideslip_smoke_state state;
    sideslip_smoke_outside outside = {};
    sideslip_smoke_sample sample = {};
    int32_t angle = 0;
    sideslip_smoke_start(&state);
    bool valid = sideslip_smoke_step(&state, &sample, &angle);
    outside.ay_count = UINT32_MAX;
    for (int i = 0; i < 3; i++) {
        sample.ax_count = (int16_t)(i - 30001);
        sample.ay_count = 30001;
        sample.yaw_rate_count = SIDESLIP_SMOKE_MISSING;
        sample.steering_wheel_count = i == 0 ? 32001 : 32000;
        sideslip_smoke_count_outside(&outside, &sample);
    }
    printf("%u %u %u %u %u", outside.ax_count, outside.ay_count, outside.yaw_rate_count,
           outside.steering_wheel_count, outside.wheel_fl_count);
    return valid && angle * SIDESLIP_SMOKE_ANGLE_SCALE > 1.0;
}
"""


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler, c++")
def test_a_program_in_cpp_counts_inputs_beyond_their_ranges(
    smoke_root: Path, tmp_path: Path
) -> None:
    """A missing one is none; a counter that is full stays so."""
    fleet = fleet_slip.open(smoke_root)
    for name, text in export_texts(fleet.models.get("smoke"), fleet.warehouse, "c").items():
        (tmp_path / name).write_text(text)
    (tmp_path / "main.cpp").write_text(COUNTING)
    strict = ["-Wall", "-Wextra", "-pedantic", "-Werror"]
    for words in (
        ["cc", "-std=c99", *strict, "-c", "sideslip_smoke.c", "-o", "smoke.o"],
        ["c++", "-std=c++14", *strict, "main.cpp", "smoke.o", "-o", "main"],
    ):
        subprocess.run(words, cwd=tmp_path, check=True, timeout=DEADLINE_S)
    assert result_of(tmp_path / "main") == (0, f"1 {2**32 - 1} 0 1 0")


def test_names_of_scales_differ_where_c_looks() -> None:
    manifest = model_of({"wheel_fl": SMALL, "wheel_fr": SMALL}, name="m" * 15)
    text = export_texts(ModelVersion(1, manifest, "0" * 64, CATALOG), None, "c")
    (header,) = [content for name, content in text.items() if name.endswith(".h")]
    names = re.findall(r"#define (\w+) ", header)
    assert len({name[:31] for name in names}) == len(names) > 6


def test_the_page_beside_them_tells_inputs_and_files(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    for to in ("c", "sql", "dbc"):
        files = export_texts(fleet.models.get("smoke"), fleet.warehouse, to)
        page = files[f"sideslip_smoke_{to}_README.md"]
        assert all(f"| `{name}` | " in page for name in files if not name.endswith(".md"))
        assert "| `ay` | m/s^2 | 0.001 | -30000 to 30000 |" in page
        assert "A tick is 0.01 s" in page
        assert ("view `log`," in page) == (to == "sql")


def result_of(program: Path) -> tuple[int, str]:
    done = subprocess.run([program], capture_output=True, text=True, check=False, timeout=60)
    return done.returncode, done.stdout


def test_the_source_has_no_floating_point_and_no_calls_of_a_library() -> None:
    manifest = model_of(MODELS["every_kind"], Fraction(5), "every_kind")
    files = export_texts(ModelVersion(1, manifest, "0" * 64, CATALOG), None, "c")
    text = files["sideslip_every_kind.h"] + files["sideslip_every_kind.c"]
    for word in ("float", "double", "malloc", "stdlib", "math.h", "1e-"):
        assert word not in text
    assert text.count("#include <") == 2


NAMES = ("mean_3", "sum_4", "heavy")
MODEL = model_of(dict.fromkeys(NAMES, Fraction(1, 10**4)), Fraction(-1, 700), "any")
KINDS = {"SWORD": "int16_t", "SLONG": "int32_t", "ULONG": "uint32_t", "UBYTE": "bool"}

MAIN = """
#include "sideslip_any.h"
DECLARED
int main(void)
{
    static sideslip_any_state state;
    const sideslip_any_car car = {0};
    sideslip_any_start(&state, &car);
    sideslip_any_valid = sideslip_any_step(&state, &sideslip_any_in, &sideslip_any_angle);
    sideslip_any_count_outside(&sideslip_any_beyond, &sideslip_any_in);
    CHECKED
    return 0;
}
"""


@pytest.fixture
def text(tmp_path: Path) -> str:
    """Export C, and write a program that declares and checks what the A2L file asks for."""
    files = export_texts(ModelVersion(1, MODEL, "0" * 64, CATALOG), None, "c")
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    document = files["sideslip_any.a2l"]
    declared = re.search(r"program:\n(.*?) \*/", document, re.DOTALL)
    assert declared is not None
    measured = re.findall(r"MEASUREMENT (\S+) .*\n  (\w+) .*\n  SYMBOL_LINK \"(\S+)\" 0", document)
    assert {symbol for _, _, symbol in measured} >= {"sideslip_any_in.ay_count"}
    checked = "\n    ".join(
        f"{{ const {KINDS[kind]} *const one = &{symbol}; (void)one; }}"
        for _, kind, symbol in measured
    )
    program = MAIN.replace("DECLARED", declared[1]).replace("CHECKED", checked)
    (tmp_path / "main.c").write_text(program)
    compile_c(tmp_path, ("main.c", "sideslip_any.c"), "-g")
    return document


def test_a_program_with_the_variables_has_each_symbol_in_its_type(text: str) -> None:
    assert text.count("/begin MEASUREMENT") == 2 * 2 + 2


@pytest.mark.tools("a2ltool")
def test_another_program_reads_it_and_finds_each_address_in_what_was_linked(
    text: str, tmp_path: Path
) -> None:
    words = ["a2ltool", "sideslip_any.a2l", "--strict", "--check", "--elffile", "program"]
    words += ["--update", "ADDRESSES", "--update-mode", "STRICT", "--output", "found.a2l"]
    done = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    addresses = re.findall(r"ECU_ADDRESS (\w+)", (tmp_path / "found.a2l").read_text())
    assert len(set(addresses)) == text.count("/begin MEASUREMENT")
