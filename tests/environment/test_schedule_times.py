"""The shipped schedules: no night is skipped or run twice when the clocks change."""

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

REPOSITORY = Path(__file__).parents[2]
TIMES = {
    "jobs/schedule/fleet-slip.timer": r"^OnCalendar=\*-\*-\* (?P<hour>\d+):(?P<minute>\d+)",
    "jobs/schedule/crontab": r"^(?P<minute>\d+) (?P<hour>\d+) \* \* \* .*nightly",
    "jobs/schedule/airflow_nightly.py": r'schedule="(?P<minute>\d+) (?P<hour>\d+) \* \* \*"',
    "jobs/schedule/dagster_nightly.py": r'cron_schedule="(?P<minute>\d+) (?P<hour>\d+) \* \* \*"',
    "docs/operations.md": r'^ *schedule: "(?P<minute>\d+) (?P<hour>\d+) \* \* \*"',
}
"""The time of the night in each file."""


@pytest.mark.parametrize("file", TIMES)
def test_every_night_has_the_time_of_the_schedule_once(file: str) -> None:
    (match,) = re.finditer(TIMES[file], (REPOSITORY / file).read_text(), re.MULTILINE)
    hour, minute = int(match["hour"]), int(match["minute"])
    for name in ("Europe/Berlin", "America/New_York", "Australia/Lord_Howe", "Africa/Cairo"):
        local = datetime(2027, 1, 1, hour, minute, tzinfo=ZoneInfo(name))
        for day in range(365):
            night = local + timedelta(days=day)  # wall clock
            assert night.astimezone(UTC).astimezone(night.tzinfo).hour == hour, (name, night)
            assert night.utcoffset() == night.replace(fold=1).utcoffset(), (name, night)
