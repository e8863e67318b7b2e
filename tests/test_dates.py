"""Days are given as dates or as text, in calls and in options."""

from datetime import date, datetime

import pytest

from fleet_slip.base import date_of, last_day
from fleet_slip.errors import UsageError

DAY = date(2024, 5, 6)


@pytest.mark.parametrize("given", [DAY, "2024-05-06", datetime(2024, 5, 6, 23, 59)])
def test_a_day_is_a_date_a_text_or_the_day_of_a_time(given: date | str) -> None:
    assert date_of(given, "since") == DAY
    assert type(date_of(given, "since")) is date


def test_none_is_no_day_and_today_may_be_a_last_day() -> None:
    assert date_of(None, "since") is None
    assert last_day("today") == date.today()


def test_what_is_no_date_is_told_with_an_example() -> None:
    with pytest.raises(UsageError, match=r"since 6 May: not a date; write it as 2024-05-01\."):
        date_of("6 May", "since")
    with pytest.raises(UsageError, match="write it as 2024-05-01, or today"):
        last_day("soon", "through")
