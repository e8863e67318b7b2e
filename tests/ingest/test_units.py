import math

import pytest

from fleet_slip.ingest.columns import conversion_factor

UNITS = {
    "rad": {"deg": math.pi / 180, "°": math.pi / 180, "mrad": 1e-3, "turn": 2 * math.pi},
    "rad/s": {"deg/s": math.pi / 180, "°/s": math.pi / 180, "rpm": 2 * math.pi / 60},
    "m/s": {"km/h": 1 / 3.6, "mph": 0.44704, "knot": 1852 / 3600, "mm/ms": 1.0},
    "m/s^2": {"g": 9.80665, "m/s²": 1.0, "m/s2": 1.0, "m/s**2": 1.0, "cm/s^2": 0.01},
    "m": {"cm": 0.01, "foot": 0.3048},
    "s": {"ms": 1e-3, "µs": 1e-6, "min": 60.0},
}


@pytest.mark.parametrize(
    ("si", "unit", "factor"), [(si, u, f) for si, units in UNITS.items() for u, f in units.items()]
)
def test_factors_are_those_of_the_definitions(si: str, unit: str, factor: float) -> None:
    assert conversion_factor(unit, si) == pytest.approx(factor, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "si"),
    [
        ("km/h", "rad"),
        ("rad", "rad/s"),
        ("percent", "rad"),  # a ratio is no angle
        ("Hz", "rad/s"),  # 1 Hz is 2π rad/s, not 1
        ("m/s", "m/s^2"),
        ("gram", "m/s^2"),
        ("g", "m"),
        ("degC", "rad"),
        ("dB", "rad"),
        ("furlongs per fortnite", "m/s"),
        ("", "m"),
        ("2 m", "m"),
        ("m^99", "m"),
        ("9^9^9^9^9", "m"),
        ("m" * 100_000, "m"),
        ("__import__('os')", "m"),
    ],
)
def test_other_units_are_refused_with_what_is_needed(unit: str, si: str) -> None:
    with pytest.raises(ValueError, match=r"needs an? \w+"):
        conversion_factor(unit, si)
