"""The minimum cohort: the one place that decides of how many cars a figure may be told.

It is off unless `FLEET_SLIP_MIN_VEHICLES` is set. Every command that tells something of cars asks
here, in one of three ways; `docs/edge.md` says what that promises and what it does not.

- What is summed up over cars counts them: `has_enough`, or `require_vehicles` if none are left.
- What is of single cars, drives or rows and nothing else is refused: `require_single_cars`.
- What is of many and names some, or has figures of some, leaves these out: `tells_single_cars`.
"""

import os

from fleet_slip.errors import CohortError, ConfigError

MINIMUM_VARIABLE = "FLEET_SLIP_MIN_VEHICLES"
"""Environment variable: the least number of cars that an answer may be of."""

UNNAMED = "cars that are not named"
"""What stands for the names of cars where they are not told."""

VIEWS_WITHOUT_CARS = ("models", "runs")
"""The views that have no row of a single car."""


def minimum_vehicles() -> int | None:
    """Return the least number of cars of an answer, None if off. Raises `ConfigError`."""
    told = os.environ.get(MINIMUM_VARIABLE)
    if told is None:
        return None
    if not told.isascii() or not told.isdecimal() or int(told) < 2:
        raise ConfigError(
            f"${MINIMUM_VARIABLE} is {told!r}, and must be a whole number of cars, at least 2. "
            "Unset it to switch the rule off."
        )
    return int(told)


def has_enough(vehicles: int) -> bool:
    """Whether figures of so many cars may be told."""
    return vehicles >= (minimum_vehicles() or 0)


def require_vehicles(vehicles: int, of: str) -> None:
    """Raise `CohortError` for an answer from fewer cars than the rule asks for."""
    if not has_enough(vehicles):
        raise CohortError(
            f"{of} has fewer than {minimum_vehicles()} cars, which ${MINIMUM_VARIABLE} asks for. "
            "Widen the cohort."
        )


def tells_single_cars() -> bool:
    """Whether names, and figures of single cars, drives and folds, may stand in an answer."""
    return minimum_vehicles() is None


def require_single_cars(what: str, instead: str) -> None:
    """Raise `CohortError` if what tells of single cars may not be told; `instead` says what may."""
    if not tells_single_cars():
        raise CohortError(f"{what} tells of single cars, and ${MINIMUM_VARIABLE} is set. {instead}")
