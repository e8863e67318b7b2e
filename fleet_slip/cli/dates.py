"""Days as options name them."""

from datetime import date

from fleet_slip.errors import UsageError


def date_of(text: str | None, option: str, example: str = "2024-05-01") -> date | None:
    """Return the day that an option names. Raises `UsageError` for anything but a date."""
    try:
        return None if text is None else date.fromisoformat(text)
    except ValueError:
        raise UsageError(f"{option} {text}: not a date; write it as {example}.") from None


def last_day(through: str | None) -> date | None:
    """Return the day that --through names. Raises `UsageError` for anything but a date or today."""
    if through == "today":
        return date.today()
    return date_of(through, "--through", "2024-05-01, or today")
