"""What a calibration tool measures of exported C: an A2L file (ASAM MCD-2 MC, ASAP2 1.71).

It names symbols instead of addresses, which the tool takes from the linked program. Whose program
it is declares the variables, under the names that stand here. Coefficients are constants inside of
a function, which no tool could change.
"""

from decimal import Decimal

from fleet_slip.export.c.c_names import c_prefix, field_names, plain_text
from fleet_slip.export.program import Program
from fleet_slip.models.model_version import ModelVersion

VARIABLES = {
    "sample": "{prefix}_sample {prefix}_in;",
    "angle": "int32_t {prefix}_angle;",
    "valid": "bool {prefix}_valid;",
    "outside": "{prefix}_outside {prefix}_beyond;",
}
"""What the program declares outside of its functions."""

_MOST = 2**32 - 1


def a2l_text(version: ModelVersion, program: Program) -> str:
    """Return the file: inputs, the angle, whether there is one, and what was out of range."""
    prefix, angle = c_prefix(version), program.angle
    about = f"{version.reference}, SHA-256 {version.sha256}"
    parts = []
    for field, one in zip(field_names(program)["signals"], program.signals, strict=True):
        count = f"{prefix}_in.{field}"
        told = f"{one.name}, missing where the count is -32768"
        low, high = one.min_count, one.max_count
        parts += [
            _linear(count, one.scale, one.unit),
            _measurement(count, told, "SWORD", count, low * one.scale, high * one.scale),
            _measurement(
                f"{prefix}_beyond.{field}",
                f"how often {one.name} was beyond its range",
                "ULONG",
                None,
                Decimal(0),
                Decimal(_MOST),
            ),
        ]
    name, most = f"{prefix}_angle", min(angle.largest, angle.limit) * angle.scale
    parts += [
        _linear(name, angle.scale, angle.unit),
        _measurement(name, angle.column, "SLONG", name, -most, most),
        _measurement(
            f"{prefix}_valid", "whether there is an angle", "UBYTE", None, Decimal(0), Decimal(1)
        ),
    ]
    declared = "\n   ".join(one.format(prefix=prefix) for one in VARIABLES.values())
    return (
        f"/* The program declares, outside of its functions:\n   {declared} */\n"
        "ASAP2_VERSION 1 71\n"
        f"/begin PROJECT {prefix} {_quoted(about)}\n/begin MODULE {prefix} {_quoted(about)}\n\n"
        + "\n".join(parts)
        + "\n/end MODULE\n/end PROJECT\n"
    )


def _linear(name: str, scale: Decimal, unit: str) -> str:
    """Return a conversion: physical = scale * count."""
    return (
        f'/begin COMPU_METHOD {name}.conversion "" LINEAR "%12.6" {_quoted(unit)}\n'
        f"  COEFFS_LINEAR {scale:f} 0\n/end COMPU_METHOD\n"
    )


def _measurement(
    name: str, told: str, kind: str, converted: str | None, low: Decimal, high: Decimal
) -> str:
    """Return a variable, whose name is also its symbol."""
    conversion = f"{converted}.conversion" if converted else "NO_COMPU_METHOD"
    return (
        f"/begin MEASUREMENT {name} {_quoted(told)}\n"
        f"  {kind} {conversion} 0 0 {low:f} {high:f}\n"
        f'  SYMBOL_LINK "{name}" 0\n/end MEASUREMENT\n'
    )


def _quoted(text: str) -> str:
    """Return a text in quotes; a slash of units stays."""
    return '"' + "/".join(map(plain_text, text.split("/"))) + '"'
