"""Applies the conversions of an MDF file, of counts to physical values.

asammdf hands the formula of a stranger to sympy, which runs it, and where it cannot it leaves the
counts. So it is asked for raw values only, and for the arithmetic that has no formula. It also
rounds the bounds of ranges, and matches other rows in a long block than in a short one.
"""

from typing import Any

import numpy as np

from fleet_slip.ingest.formats.formulas import compute_formula

_NONE, _FORMULA, _RANGES_TO_NUMBERS, _VALUES_TO_TEXT, _RANGES_TO_TEXT, _TABLE, _PLAIN, _TEXT = (
    "none", "formula", "ranges to numbers", "values to text", "ranges to text", "table", "plain",
    "text",
)  # fmt: skip
_KINDS = {
    b"##CC": {
        0: _NONE, 1: _PLAIN, 2: _PLAIN, 3: _FORMULA, 4: _TABLE, 5: _TABLE, 6: _RANGES_TO_NUMBERS,
        7: _VALUES_TO_TEXT, 8: _RANGES_TO_TEXT, 9: _TEXT, 10: _TEXT, 11: _TEXT,
    },
    b"CC": {
        65535: _NONE, 0: _PLAIN, 1: _TABLE, 2: _TABLE, 6: _PLAIN, 9: _PLAIN, 10: _FORMULA,
        11: _TEXT, 12: _RANGES_TO_TEXT,
    },
}  # fmt: skip
"""What becomes of each type of conversion, of MDF 4 and of MDF 3; others are refused."""

Array = np.ndarray[Any, Any]


def conversion_of(channel: Any) -> Any:
    """Return a channel's conversion, or None. Raises `ValueError` if asammdf lost it."""
    if channel.conversion is None and channel.conversion_addr:
        raise ValueError("its conversion cannot be read, or is of an unknown type")
    return channel.conversion


def require_arithmetic(conversion: Any) -> None:
    """Raise `ValueError` for one that asammdf may not apply itself, as it does to times."""
    if _kind_of(conversion) not in {_NONE, _PLAIN}:
        raise ValueError("times that a formula or a table computes are not read")


def to_physical(conversion: Any, raw: Array) -> Array:
    """Return physical values, texts as bytes. Raises `ValueError` for what cannot be applied."""
    kind = _kind_of(conversion)
    if kind == _NONE:
        return raw
    if kind == _FORMULA:
        return _by_formula(conversion.formula, raw)
    if kind in {_VALUES_TO_TEXT, _RANGES_TO_TEXT, _RANGES_TO_NUMBERS}:
        return _by_ranges(conversion, kind, raw)
    if kind == _TABLE and np.any(np.diff(_listed(conversion, "raw")) < 0):
        raise ValueError("the table of its conversion is not in order")
    if any(not isinstance(part, bytes) for part in conversion.referenced_blocks.values()):
        raise ValueError("the parts of its conversion are conversions themselves")
    converted: Array = conversion.convert(raw)
    return converted


def _kind_of(conversion: Any) -> str:
    if conversion is None:
        return _NONE
    kinds, number = _KINDS[conversion.id], conversion.conversion_type
    if number not in kinds:
        raise ValueError(f"a conversion of type {number} is not applied")
    return kinds[number]


def _by_formula(formula: str, raw: Array) -> Array:
    try:
        return compute_formula(formula.strip("\0"), raw.astype(np.float64))
    except ValueError as error:
        raise ValueError(f"its formula {formula[:100]!r} is not computed: {error}") from None


def _listed(conversion: Any, name: str) -> Array:
    """Return parameters that are numbered from 0 on."""
    of, found = vars(conversion), list[float]()
    while f"{name}_{len(found)}" in of:
        found.append(of[f"{name}_{len(found)}"])
    return np.array(found, dtype=np.float64)


def _by_ranges(conversion: Any, kind: str, raw: Array) -> Array:
    """Return what a table says of ranges, or of single values; integers include the upper end."""
    points = kind == _VALUES_TO_TEXT
    lower, upper = (_listed(conversion, "val" if points else end) for end in ("lower", "upper"))
    order = np.argsort(lower, kind="stable")
    lower, upper = np.append(lower[order], np.inf), np.append(upper[order], -np.inf)
    place = np.searchsorted(lower[:-1], raw, side="right") - 1
    ends = (raw.dtype.kind in "iub") | (lower == upper)
    inside = (raw < upper[place]) | (ends[place] & (raw == upper[place]))
    place = np.where(inside & (place >= 0), place, len(order))
    if kind == _RANGES_TO_NUMBERS:
        return np.append(_listed(conversion, "phys")[order], conversion.default)[place]
    texts = conversion.referenced_blocks
    parts = [*(texts[f"text_{number}"] for number in order), texts["default_addr"]]
    if all(isinstance(part, bytes) and b"{X}" not in part for part in parts):
        return np.array(parts, dtype=bytes)[place]
    values = np.full(raw.shape, np.nan)  # of which some have a name instead
    for number in np.unique(place).tolist():
        part, mine = parts[number], place == number
        if not isinstance(part, bytes):
            values[mine] = to_physical(part, raw[mine])
        elif b"{X}" in part:  # of MDF 3, between quotes
            formula = part.decode("latin-1").replace("{X}", "X")
            values[mine] = _by_formula(formula.strip().strip('"'), raw[mine])
    return values
