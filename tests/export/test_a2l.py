"""A2L files beside exported C: their symbols are those of a program that declares what they ask."""

import re
import subprocess
from fractions import Fraction
from pathlib import Path

import pytest

from fleet_slip.models.registry import ModelVersion
from tests.export.compiled import compile_c, needs_cc
from tests.export.models import export_texts, model_of

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
    files = export_texts(ModelVersion(1, MODEL, "0" * 64), None, "c")
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    found = files["sideslip_any.a2l"]
    declared = re.search(r"functions:\n(.*?) \*/", found, re.DOTALL)
    assert declared is not None
    measured = re.findall(r"MEASUREMENT (\S+) .*\n  (\w+) .*\n  SYMBOL_LINK \"(\S+)\" 0", found)
    assert {symbol for _, _, symbol in measured} >= {"sideslip_any_in.ay_count"}
    checked = "\n    ".join(
        f"{{ const {KINDS[kind]} *const one = &{symbol}; (void)one; }}"
        for _, kind, symbol in measured
    )
    program = MAIN.replace("DECLARED", declared[1]).replace("CHECKED", checked)
    (tmp_path / "main.c").write_text(program)
    return found


@needs_cc
def test_a_program_with_the_variables_has_each_symbol_in_its_type(
    text: str, tmp_path: Path
) -> None:
    assert text.count("/begin MEASUREMENT") == 2 * 2 + 2
    compile_c(tmp_path, ("main.c", "sideslip_any.c"))


@pytest.mark.tools("a2ltool")
def test_another_program_reads_it_and_finds_each_address_in_what_was_linked(
    text: str, tmp_path: Path
) -> None:
    compile_c(tmp_path, ("main.c", "sideslip_any.c"), "-g")
    words = ["a2ltool", "sideslip_any.a2l", "--strict", "--check", "--elffile", "program"]
    words += ["--update", "ADDRESSES", "--update-mode", "STRICT", "--output", "found.a2l"]
    done = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    addresses = re.findall(r"ECU_ADDRESS (\w+)", (tmp_path / "found.a2l").read_text())
    assert len(set(addresses)) == text.count("/begin MEASUREMENT")
