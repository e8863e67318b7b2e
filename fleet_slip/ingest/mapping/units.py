"""Factors from the units that people log in to the catalogue's SI units."""

import re
from functools import cache

import pint

_TERM = r"(?:°|[^\W\d]+\d?)(?:(?:\^|\*\*)-?\d)?"
_UNIT = re.compile(rf"(?:1/)?{_TERM}(?:[*/ ]{_TERM})*")
_POWER = re.compile(r"(?<=[^\W\d_])([2-9])(?!\w)")
_LONGEST_UNIT = 40

_NEEDS = {
    "rad": "an angle, such as 'deg'",
    "rad/s": "an angular velocity, such as 'deg/s' or 'rpm'",
    "m": "a length, such as 'm'",
    "m/s": "a velocity, such as 'km/h'",
    "m/s^2": "an acceleration, such as 'g' or 'm/s^2'",
    "s": "a time, such as 'ms'",
    "Pa": "a pressure, such as 'bar'",
    "1": "a number: '1', or '%'",
}
_NUMBERS = {"1": 1.0, "%": 0.01, "percent": 0.01}


def require_unit(unit: str, si_unit: str, quantity: str = "it") -> None:
    """Raise `ValueError` for a unit that has no `conversion_factor`."""
    conversion_factor(unit, si_unit, quantity)


@cache
def conversion_factor(unit: str, si_unit: str, quantity: str = "it") -> float:
    """Return f in `value in si_unit = f * value in unit`; `quantity` is what messages call it.

    In an acceleration `g` is standard gravity, 9.80665 m/s² (elsewhere it would be the gram). The
    radian counts as a dimension, so that neither a ratio passes for an angle nor Hz for rad/s:
    what fits in dimension only is off by 2π or by 100 and would never be noticed.

    Raises `ValueError`, with a message that ends in what is needed instead.
    """
    needs = f"{quantity} needs {_NEEDS.get(si_unit, f'a unit like {si_unit!r}')}"
    if si_unit == "1" and unit in _NUMBERS:
        return _NUMBERS[unit]
    # The pattern keeps pint from evaluating arithmetic: '9^9^9^9' would never end.
    if len(unit) > _LONGEST_UNIT or not _UNIT.fullmatch(unit):
        raise ValueError(f"is in {unit[:_LONGEST_UNIT]!r}, which is not a unit; {needs}")
    registry = pint.application_registry
    name = "standard_gravity" if unit == "g" and si_unit == "m/s^2" else unit
    if name not in registry:  # a digit after a letter is a power, as in m/s2
        name = _POWER.sub(r"^\1", name)
    try:
        root = registry.Quantity(1.0, name).to_root_units()
        wanted = registry.Quantity(1.0, si_unit).to_root_units()
    except (pint.PintError, ValueError, TypeError, AttributeError):
        raise ValueError(f"is in {unit!r}, which is not a known unit; {needs}") from None
    if root.units != wanted.units:
        raise ValueError(f"is in {unit!r}, {needs}")
    return float(root.magnitude) / float(wanted.magnitude)
