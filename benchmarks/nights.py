"""Thirty nights with real cars' faults: late files, a broken sensor, a bad mapping, a killed run.

    python -m benchmarks.nights ROOT [--nights 30] [--output FOLDER]

The drives of the data root ROOT, such as that of `make run`, land a few each night. Prints what
each night came to, and writes the summaries. At the end the root is verified, and compared with
one where the same files landed without a kill.
"""

import argparse
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import fleet_slip
from fleet_slip.monitoring.night_page import write_summary
from fleet_slip.monitoring.night_report import NightReport
from tests.support.commands import COMMAND
from tests.support.landing import Landing
from tests.support.state import state

FIRST = date(2026, 10, 1)
DRIVES = 3
"""That come home each day."""
LATE = {7: 9, 15: 18}
"""The log of a day that lands in a later night."""
BROKEN = {11: {"yaw_rate_rad_s": "0.02"}, 20: {"ay_mps2": "-ay_mps2"}}
"""Days on which a sensor is broken, and how."""
BAD_MAPPING = (13,)
TORN = (22,)
"""Nights in which half a file lies in the folder; the next morning somebody mends it."""
KILLED = {5: 2.0, 16: 4.0, 25: 6.0}
"""Nights that are killed after so many seconds, and given again."""


@dataclass(frozen=True)
class Nights:
    """Where the logs land, and where the night's root is."""

    landing: Landing
    root: Path
    output: Path
    kills: bool

    def land(self, night: int) -> None:
        """Let the logs of a day land, or those of an earlier one that are late."""
        drives = self.landing.drives()
        days = [day for day, lands in LATE.items() if lands == night]
        for day in days if night in LATE else [night, *days]:
            of_day = [drives[(DRIVES * day + k) % len(drives)] for k in range(DRIVES)]
            changes = {**BROKEN.get(day, {}), "drive_id": f"'night-{day}-' || drive_id"}
            self.landing.land(f"day-{day:02}", of_day, FIRST + timedelta(day), **changes)

    def give(self, night: int) -> NightReport:
        """Do a night; a bad mapping or half a file is its own fault."""
        mapping = self.landing.mapping
        if night in BAD_MAPPING:
            mapping = mapping.with_name("bad.toml")
            mapping.write_text(self.landing.mapping.read_text().replace("m/s^2", "furlongs"))
        torn = self.landing.folder / "torn.parquet"
        if night in TORN:
            torn.write_bytes(b"PAR1 half a file")
        if self.kills and night in KILLED:
            self._kill(night)
        report = fleet_slip.open(self.root).nightly(
            self.landing.folder,
            str(mapping),
            "fleet",
            models="table1",
            night=FIRST + timedelta(night),
        )
        write_summary(report, self.output)
        torn.unlink(missing_ok=True)
        return report

    def _kill(self, night: int) -> None:
        """Give the night in a process of its own, and kill it."""
        command = [COMMAND, "--root", str(self.root), "nightly"]
        options = ["--landing", self.landing.folder, "--mapping", self.landing.mapping]
        options += ["--model", "fleet", "--models", "table1", "--night", FIRST + timedelta(night)]
        process = subprocess.Popen(
            [*command, *map(str, options)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(KILLED[night])
        process.kill()
        print(f"night {night}: killed, {'had ended' if process.wait() >= 0 else 'under way'}")


def live(source: Path, folder: Path, output: Path, nights: int, *, kills: bool) -> Path:
    """Live through the nights below a folder; return the data root."""
    landing = Landing(folder / "landing", source)
    landing.prepare()
    lived = Nights(landing, folder / "data", output, kills)
    for night in range(nights):
        lived.land(night)
        begun = time.monotonic()
        report = lived.give(night)
        print(
            f"{report.night}  exit {report.exit_code:2}  {time.monotonic() - begun:5.1f} s  "
            f"{report.gained}; {report.champion}; {report.verdict}",
            flush=True,
        )
    return lived.root


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("--nights", type=int, default=30)
    parser.add_argument("--output", type=Path, default=Path("nights"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        killed = live(arguments.root, place / "a", arguments.output, arguments.nights, kills=True)
        verified = fleet_slip.open(killed).verify()
        assert not verified.damage, verified.damage
        print(f"verified: {verified.files} files, {verified.documents} documents, no damage")
        whole = live(arguments.root, place / "b", place / "out", arguments.nights, kills=False)
        same = state(killed, "fleet") == state(whole, "fleet")
        print(f"the same bits as without a kill: {'yes' if same else 'NO'}")
        shutil.rmtree(place / "b")
        assert same


if __name__ == "__main__":
    main()
