"""Exported C under clang, and the rules of MISRA C:2012 that cppcheck knows."""

import re
import subprocess
from fractions import Fraction
from pathlib import Path

import pytest

from fleet_slip.export.c import cost_on_board
from fleet_slip.export.c_gram import sets_on_board
from fleet_slip.export.files import export_files
from fleet_slip.models.registry import ModelVersion
from tests.export.compiled import STRICT, learned, run_compiled, write_counter
from tests.export.models import MODELS, export_texts, model_of
from tests.support.catalog import CATALOG
from tests.support.cortex_m import measure_cortex_m, run_self_test

DEVIATIONS = {"misra-c2012-15.5", "misra-c2012-2.5", "misra-c2012-8.7"}
"""All are advisory: a message of no part returns at once, the header names the version, and
the functions are called from elsewhere, which recent versions look for. docs/export.md says so."""


@pytest.fixture(params=MODELS)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    manifest = model_of(MODELS[request.param], Fraction(-1, 700), "any")
    version = ModelVersion(1, manifest, "0" * 64, CATALOG)
    for name, text in export_files(version, None, "c", with_gram=True).items():
        (tmp_path / name).write_bytes(text)
    return tmp_path


@pytest.mark.tools("clang", "cppcheck")
def test_code_that_counts_course_changes_obeys_the_same_rules(tmp_path: Path) -> None:
    write_counter(tmp_path, sets_on_board(CATALOG, learned()))
    run(tmp_path, "clang", *STRICT, "-c", "any_gram.c")
    require_misra(tmp_path, "any_gram.c")


def require_misra(folder: Path, *files: str) -> None:
    checks = ("--std=c99", "--addon=misra", "--enable=warning,style,portability", "-q")
    report = run(folder, "cppcheck", *checks, *files)
    assert set(re.findall(r"\[(\S+)\]$", report, re.M)) <= DEVIATIONS, report


def run(folder: Path, *words: str) -> str:
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.mark.tools("clang")
def test_clang_has_no_warning_and_the_self_test_passes(folder: Path) -> None:
    run(folder, "clang", *STRICT, "sideslip_any.c", "sideslip_any_test.c", "-o", "self_test")
    run(folder, "clang", *STRICT, "-c", "sideslip_any_gram.c")
    assert "0 of 900 angles are wrong" in run(folder, "./self_test")


@pytest.mark.tools("cppcheck")
def test_it_keeps_the_rules_of_misra_but_those_that_are_listed(folder: Path) -> None:
    require_misra(folder, "sideslip_any.c", "sideslip_any_gram.c")


@pytest.mark.tools("arm-none-eabi-gcc", "qemu-system-arm")
def test_the_self_test_passes_on_a_cortex_m(tmp_path: Path) -> None:
    """Four columns with windows take less than 4 kB of code and 2 kB of memory."""
    names = ("mean_3", "mean_5", "sum_4", "change_mean")
    manifest = model_of(dict.fromkeys(names, Fraction(1, 10**4)), Fraction(-1, 700), "any")
    files = export_texts(ModelVersion(1, manifest, "0" * 64, CATALOG), None, "c")
    costs = measure_cortex_m(tmp_path, "sideslip_any", files)
    assert run_self_test(tmp_path) == 0
    assert costs["with_divisions_of_64_bits_bytes"] < 4096
    assert costs["state_bytes"] + costs["largest_frame_bytes"] < 2048
    assert 100 < costs["most_instructions"] < 3000


@pytest.mark.tools("arm-none-eabi-gcc", "qemu-system-arm")
@pytest.mark.parametrize("name", MODELS)
def test_estimates_for_a_cortex_m_are_above_what_is_measured(tmp_path: Path, name: str) -> None:
    version = ModelVersion(1, model_of(MODELS[name], Fraction(-1, 700), name), "0" * 64, CATALOG)
    estimated = cost_on_board(CATALOG, version.manifest)
    costs = measure_cortex_m(tmp_path, f"sideslip_{name}", export_texts(version, None, "c"))
    assert costs["state_bytes"] == estimated.memory_bytes
    assert 0.5 < costs["most_instructions"] / estimated.estimated_instructions <= 1
    assert 0.5 < costs["with_divisions_of_64_bits_bytes"] / estimated.estimated_code_bytes <= 1


@pytest.mark.tools("arm-none-eabi-gcc", "qemu-system-arm")
@pytest.mark.parametrize("folder", ["every_kind", "learning"], indirect=True)
def test_a_wrong_angle_is_noticed_on_a_cortex_m(folder: Path) -> None:
    source = (folder / "sideslip_any.c").read_text()
    files = {path.name: path.read_text() for path in folder.glob("*.[ch]")}
    files["sideslip_any.c"] = source.replace("high += (int64_t)", "high -= (int64_t)")
    assert files["sideslip_any.c"] != source  # which passes, as the test above shows
    with pytest.raises(subprocess.CalledProcessError):
        measure_cortex_m(folder, "sideslip_any", files)


@pytest.mark.tools("clang")
def test_libfuzzer_finds_nothing(folder: Path) -> None:
    fuzzed = ("-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all", "-g", "-O1")
    words = ("clang", *STRICT, *fuzzed, "sideslip_any.c", "sideslip_any_fuzz.c", "-o", "fuzz")
    built = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if "libclang_rt.fuzzer" in built.stderr:
        pytest.skip("clang's runtime of libFuzzer is not here: apt-get install libclang-rt-14-dev")
    assert built.returncode == 0, built.stderr
    command = ("./fuzz", "-seed=1", "-runs=20000", "-max_len=4000", "-rss_limit_mb=512")
    run_compiled(command, folder)
