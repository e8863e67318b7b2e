"""The cost of exported C on a Cortex-M4: compiled by arm-none-eabi-gcc, run by qemu.

No library of C is linked: `cortex/startup.c` calls `main`, and what it returns ends qemu. Stack
and code are the compiler's figures with -Os. qemu runs one instruction at a time and names each, so
that those between the call of a step and its return can be counted.
"""

import re
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from shutil import copy, which

CORTEX = Path(__file__).parent / "cortex"
TOOLS = ("arm-none-eabi-gcc", "arm-none-eabi-size", "arm-none-eabi-nm", "qemu-system-arm")
TARGET = ("-mcpu=cortex-m4", "-mthumb", "-std=c99", "-Os")
STRICT = ("-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror")
QEMU = ("qemu-system-arm", "-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "none")
DEADLINE_S = 300

LEAST = """#include "PREFIX.h"
PREFIX_state state;
PREFIX_sample sample;
int32_t angle;
int main(void)
{
    CAR
    return PREFIX_step(&state, &sample, &angle) ? 0 : 1;
}
"""


def can_measure() -> bool:
    """Return True if the tools are installed."""
    return all(which(tool) for tool in TOOLS)


def measure_cortex_m(folder: Path, prefix: str, files: Mapping[str, str]) -> dict[str, int]:
    """Return the figures of an export to C; `files` are its texts.

    Raises `subprocess.CalledProcessError` for a warning, or if an angle of the self-test is wrong.
    """
    for name, text in files.items():
        (folder / name).write_text(text)
    for name in ("startup.c", "cortex_m4.ld"):
        copy(CORTEX / name, folder)
    run(folder, *gcc("-c", *STRICT, "-fstack-usage", f"{prefix}.c"))
    run(folder, *gcc("-c", "startup.c"))
    (folder / "bare.c").write_text(without_printing(files[f"{prefix}_test.c"]))
    link(folder, "self_test.elf", f"{prefix}.o", "bare.c")
    car = f"static {prefix}_car car;\n    {prefix}_start(&state, &car);"
    start = car if f"{prefix}_car;" in files[f"{prefix}.h"] else f"{prefix}_start(&state);"
    (folder / "least.c").write_text(LEAST.replace("CAR", start).replace("PREFIX", prefix))
    run(folder, *gcc("-c", "least.c"))
    link(folder, "least.elf", f"{prefix}.o", "least.o")
    state = re.search(
        r"^\S+ (\S+) . state$", run(folder, "arm-none-eabi-nm", "-S", "least.elf"), re.M
    )
    assert state
    model_bytes = text_bytes(folder, f"{prefix}.o")
    overhead_bytes = text_bytes(folder, "least.o") + text_bytes(folder, "startup.o")
    stack = [int(line.split()[1]) for line in (folder / f"{prefix}.su").read_text().splitlines()]
    return {
        "code_and_constants_bytes": model_bytes,
        "with_divisions_of_64_bits_bytes": text_bytes(folder, "least.elf") - overhead_bytes,
        "state_bytes": int(state[1], 16),
        "largest_frame_bytes": max(stack),
        "most_instructions": max(instructions_of_calls(folder, "self_test.elf", f"{prefix}_step")),
    }


def gcc(*words: str) -> tuple[str, ...]:
    return ("arm-none-eabi-gcc", *TARGET, *words)


def link(folder: Path, program: str, *parts: str) -> None:
    """Link parts for the board, without a library but the compiler's own."""
    linked = ("-nostartfiles", "-nostdlib", "-T", "cortex_m4.ld", "startup.o")
    run(folder, *gcc(*linked, *parts, "-lgcc", "-o", program))


def without_printing(self_test: str) -> str:
    """Return a self-test whose result alone tells how it ended."""
    text = self_test.replace("#include <stdio.h>\n", "")
    return re.sub(r" *\(void\)printf\(.*?\);\n", "", text, flags=re.S)


def run_self_test(folder: Path, program: str = "self_test.elf") -> int:
    """Run a program in qemu; return what its `main` returned."""
    words = [*QEMU, "-semihosting", "-kernel", program]
    done = subprocess.run(words, cwd=folder, check=False, timeout=DEADLINE_S)
    return done.returncode


def instructions_of_calls(folder: Path, program: str, function: str) -> Iterator[int]:
    """Yield the number of instructions of each call of a function by `main`.

    Raises `subprocess.CalledProcessError` if the program does not end with 0.
    """
    words = [*QEMU, "-semihosting", "-singlestep", "-d", "exec,nochain", "-kernel", program]
    with subprocess.Popen(words, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        yield from _counted(process.stderr, function)
        code = process.wait(DEADLINE_S)
    if code:
        raise subprocess.CalledProcessError(code, words)


def _counted(lines: Iterable[str], function: str) -> Iterator[int]:
    count, inside = 0, False
    for line in lines:
        name = line.rpartition("] ")[2].strip()
        if name == function:
            inside = True
        elif inside and (name == "main" or name.startswith("run_")):
            yield count
            count, inside = 0, False
        count += inside


def text_bytes(folder: Path, file: str) -> int:
    """Return the bytes of code and constants."""
    return int(run(folder, "arm-none-eabi-size", file).splitlines()[1].split()[0])


def run(folder: Path, *words: str) -> str:
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, check=True, timeout=DEADLINE_S
    )
    return done.stdout
