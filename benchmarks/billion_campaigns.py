"""The campaigns of `benchmarks.billion`: the fleet that ships, with as many rows as asked for.

300 cars of four models on two circuits; drives of a quarter of an hour, as people drive. Rows are
reached by days and drives a day, so that files keep their million rows whatever the number is.
"""

import re
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np

from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import Campaign, load_campaign

SHIPPED = "fleet"
FIRST_DAY = date(2024, 6, 1)
ROWS_PER_DAY = 1_000_000
ROWS_PER_FILE = 1_100_000
"""Room for days that come out longer than planned, so that a day of a million is one file."""
DAYS_MAX = 100
LAPS = 5.0
DRIVES_MIN = 4
PROBED_DRIVES = 2000
NEW_SHARE = 0.01
"""A new day brings so much of the rows that are there."""


@dataclass(frozen=True)
class Sized:
    """How much a campaign drives."""

    name: str
    first_day: date
    days: int
    drives_per_day: int
    laps: float


def history(rows: int) -> Sized:
    """Return the campaign of about so many rows: days of a million or more, at most a hundred."""
    days = max(1, min(DAYS_MAX, rows // ROWS_PER_DAY))
    return _sized("history", FIRST_DAY, days, rows)


def new_day(rows: int) -> Sized:
    """Return one more day, of a hundredth of the rows."""
    day = FIRST_DAY + timedelta(days=DAYS_MAX)
    return _sized("new_day", day, 1, round(NEW_SHARE * rows))


def write(sized: Sized, folder: Path) -> Path:
    """Write a campaign's file and return its path."""
    path = folder / f"{sized.name}.toml"
    path.write_text(_text(sized), encoding="utf-8")
    return path


def _sized(name: str, first_day: date, days: int, rows: int) -> Sized:
    daily_rows = rows / days
    at_first = Sized(name, first_day, 1, PROBED_DRIVES, LAPS)
    per_drive = _mean_rows(at_first)
    laps = LAPS * min(1.0, daily_rows / (DRIVES_MIN * per_drive))
    drives = max(DRIVES_MIN, round(daily_rows / per_drive))
    probed = Sized(name, first_day, 1, min(PROBED_DRIVES, days * drives), laps)
    return Sized(
        name, first_day, days, drives, round(laps * daily_rows / drives / _mean_rows(probed), 4)
    )


def _mean_rows(sized: Sized) -> float:
    campaign = sized_campaign(sized)
    return float(np.mean([drive.expected_rows for drive in campaign.drives(campaign.first_day)]))


def sized_campaign(sized: Sized) -> Campaign:
    """Return the campaign itself."""
    return load_campaign(SHIPPED, SHIPPED_CONFIGS).model_copy(
        update={
            "name": sized.name,
            "first_day": sized.first_day,
            "number_of_days": sized.days,
            "drives_per_day": sized.drives_per_day,
            "laps": sized.laps,
        }
    )


def _text(sized: Sized) -> str:
    text = SHIPPED_CONFIGS.find("campaigns", SHIPPED).read_text(encoding="utf-8")
    values = {
        "name": f'"{sized.name}"',
        "first_day": sized.first_day.isoformat(),
        "number_of_days": str(sized.days),
        "drives_per_day": str(sized.drives_per_day),
        "laps": str(sized.laps),
        "rows_per_file": str(ROWS_PER_FILE),
    }
    for key, value in values.items():
        text, count = re.subn(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
        assert count == 1, key
    return text
