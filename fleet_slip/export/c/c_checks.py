"""The self-test of an exported estimator in C: its checks as tables, and what runs them."""

from collections.abc import Sequence

from fleet_slip.export.c.c_names import c_prefix, field_names, plain_text, read_template
from fleet_slip.export.checks import Check
from fleet_slip.export.program import Program
from fleet_slip.models.model_version import ModelVersion


def c_self_test(version: ModelVersion, program: Program, checks: Sequence[Check]) -> str:
    """Return the source of a program that ends with 0 if the angles of all checks agree."""
    prefix = c_prefix(version)
    tables = "\n".join(_tables(number, check) for number, check in enumerate(checks))
    runs = "\n".join(f"    wrong += run_{number}();" for number in range(len(checks)))
    total = sum(len(check.angles) for check in checks)
    functions = "\n".join(_run(prefix, program, number, one) for number, one in enumerate(checks))
    return (
        f"/* Self-test of {version.reference}. It prints nothing but its result. */\n"
        f'#include <stdio.h>\n\n#include "{prefix}.h"\n\n'
        "#define NO_ANGLE INT32_MIN\n\n"
        f"{tables}\n{functions}\n"
        "int main(void)\n{\n    uint32_t wrong = 0U;\n"
        f"{runs}\n"
        f'    (void)printf("{version.reference}: %lu of {total} angles are wrong\\n", '
        "(unsigned long)wrong);\n"
        "    return (wrong == 0U) ? 0 : 1;\n}\n"
    )


def _tables(number: int, check: Check) -> str:
    rows = ",\n    ".join("{" + ", ".join(map(_count, sample)) + "}" for sample in check.samples)
    width = len(check.samples[0])
    angles = ", ".join("NO_ANGLE" if one is None else str(one) for one in check.angles)
    return (
        f"/* {plain_text(check.name)} */\n"
        f"static const int16_t samples_{number}[{len(check.samples)}][{width}] = {{\n"
        f"    {rows}\n}};\n\n"
        f"static const int32_t angles_{number}[{len(check.angles)}] = {{\n    {angles}\n}};\n"
    )


def _count(count: int | None) -> str:
    return str(count) if count is not None and abs(count) < 2**15 else "INT16_MIN"


def _run(prefix: str, program: Program, number: int, check: Check) -> str:
    fields = field_names(program)
    known = [*check.facts, *check.numbers]
    car, given = "", ""
    if known:
        values = ", ".join("INT32_MIN" if one is None else str(one) for one in known)
        car, given = f"    const {prefix}_car car = {{ {values} }};\n", ", &car"
    takes = "\n".join(
        f"        sample.{field} = samples_{number}[i][{place}];"
        for place, field in enumerate(fields["signals"])
    )
    return read_template("run_check.c").substitute(
        number=number, prefix=prefix, car=car, given=given, ticks=len(check.angles), takes=takes
    )


def c_fuzz_target(version: ModelVersion, program: Program) -> str:
    """Return a fuzz target for libFuzzer: a car, then samples, of any bytes."""
    prefix, knows = c_prefix(version), program.facts or program.numbers
    known = (
        f"    {prefix}_car car;\n    if (size < sizeof car) {{ return 0; }}\n"
        "    (void)memcpy(&car, data, sizeof car);\n    at = sizeof car;\n"
    )
    return read_template("fuzz.c").substitute(
        model=version.reference,
        prefix=prefix,
        known=known if knows else "",
        given=", &car" if knows else "",
    )
