"""The rule of a minimum cohort, which can be switched on: no answer from fewer than k cars."""

import os

from fleet_slip.errors import CohortError, ConfigError

MINIMUM_VARIABLE = "FLEET_SLIP_MIN_VEHICLES"
"""Environment variable: the least number of cars that an answer may be of."""

VIEWS_WITHOUT_CARS = ("models", "runs")
"""The views that have no row of a single car."""


def minimum_vehicles() -> int | None:
    """Return the least number of cars of an answer; None where the rule is off.

    Raises `ConfigError` for what is no whole number above 1: a wrong one does not switch it off.
    """
    told = os.environ.get(MINIMUM_VARIABLE)
    if told is None:
        return None
    if not told.isascii() or not told.isdecimal() or int(told) < 2:
        raise ConfigError(
            f"${MINIMUM_VARIABLE} is {told!r}, and must be a whole number of cars, at least 2. "
            "Unset it to switch the rule off."
        )
    return int(told)


def require_vehicles(vehicles: int, of: str) -> None:
    """Raise `CohortError` for an answer from fewer cars than the rule asks for."""
    least = minimum_vehicles()
    if least is not None and vehicles < least:
        raise CohortError(
            f"{of} has fewer than {least} cars, which ${MINIMUM_VARIABLE} asks for. Widen the "
            "cohort."
        )
