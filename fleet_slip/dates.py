"""Days as people write them, in options and in calls."""

from datetime import date, datetime
from typing import overload

from fleet_slip.errors import UsageError

EXAMPLE = "2024-05-01"


@overload
def date_of(day: date | str, name: str, example: str = EXAMPLE) -> date: ...
@overload
def date_of(day: date | str | None, name: str, example: str = EXAMPLE) -> date | None: ...


def date_of(day: date | str | None, name: str, example: str = EXAMPLE) -> date | None:
    """Return the day that an option or argument names; of a time, its day.

    Raises `UsageError` for anything but a date.
    """
    if isinstance(day, datetime):
        return day.date()
    if day is None or isinstance(day, date):
        return day
    try:
        return date.fromisoformat(day)
    except (ValueError, TypeError):
        raise UsageError(f"{name} {day}: not a date; write it as {example}.") from None


def last_day(through: date | str | None, name: str = "--through") -> date | None:
    """Return the last day that is named. Raises `UsageError` for anything but a date or today."""
    return date.today() if through == "today" else date_of(through, name, f"{EXAMPLE}, or today")
