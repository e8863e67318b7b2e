"""What to type after the first run: commands that work as they stand on the data just made."""

import os
import shlex
import shutil
import sys
from pathlib import Path

from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import FleetSlipError
from fleet_slip.files.data_root import data_root
from fleet_slip.warehouse.minimum_cohort import tells_single_cars


def next_steps(fleet: Fleet, campaign: str, model: str) -> list[str]:
    """Return command lines to go on with: a query, the model, a cohort, the test drives."""
    begin = f"{program()}{_root_option(fleet)}"
    query = "SELECT drive_id, max(abs(degrees(sideslip_rad))) AS beta_deg FROM log GROUP BY ALL"
    lines = [f'{begin} sql "{query}"', f"{begin} show {model}"]
    if cohort := _faster_half(fleet, campaign):
        lines.append(f'{begin} select --cohort "{cohort}"')
    lines.append(f"{begin} evaluate {model} && {begin} report {model}")
    return lines


def program() -> str:
    """Return how this program is called from here: by name where that finds it, else by path."""
    called = Path(sys.argv[0])
    found = shutil.which(called.name)
    if found and os.path.realpath(found) == os.path.realpath(called):
        return called.name
    here = Path.cwd()
    path = called.absolute()
    return shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path))


def _root_option(fleet: Fleet) -> str:
    """Return the option that names the data root, unless it is the usual one."""
    try:
        usual = str(data_root())
    except FleetSlipError:
        usual = ""
    return "" if str(fleet.root) == usual else f" --root {shlex.quote(str(fleet.root))}"


def _faster_half(fleet: Fleet, campaign: str) -> str | None:
    """Return a condition that about half of the campaign's drives satisfy; None if none is told."""
    if not tells_single_cars():
        return None
    medians = fleet.sql("SELECT campaign, median(speed_factor) FROM drives GROUP BY ALL").fetchall()
    speed = dict(medians).get(campaign)
    return None if speed is None else f"speed_factor > {speed:.2f}"
