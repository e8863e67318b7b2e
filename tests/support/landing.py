"""A folder where the logs of real cars land, each night those of one day."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import duckdb

import fleet_slip

MAPPING = """\
name = "landing"

[time]
column = "time_s"
unit = "s"

[drive]
column = "drive_id"
day = { column = "day" }
vehicle_id = { column = "vehicle_id" }
vehicle_model = { column = "vehicle_model" }
mass_kg = { column = "mass_kg" }

[signals]
ax = { column = "ax_mps2", unit = "m/s^2" }
ay = { column = "ay_mps2", unit = "m/s^2" }
yaw_rate = { column = "yaw_rate_rad_s", unit = "rad/s" }
steering_wheel = { column = "steering_wheel_rad", unit = "rad" }
wheel_fl = { column = "wheel_fl_rad_s", unit = "rad/s" }
wheel_fr = { column = "wheel_fr_rad_s", unit = "rad/s" }
wheel_rl = { column = "wheel_rl_rad_s", unit = "rad/s" }
wheel_rr = { column = "wheel_rr_rad_s", unit = "rad/s" }
steer_fl = { column = "steer_fl_rad", unit = "rad" }
steer_fr = { column = "steer_fr_rad", unit = "rad" }
sideslip = { column = "sideslip_rad", unit = "rad" }
"""


@dataclass(frozen=True)
class Landing:
    """Parquet logs of the drives of a data root, as a logger would write them."""

    folder: Path
    source: Path

    @property
    def mapping(self) -> Path:
        return self.folder.with_name("landing.toml")

    def prepare(self) -> None:
        """Make the folder and the mapping."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.mapping.write_text(MAPPING)

    def drives(self) -> list[str]:
        """Return the drives that can land, by day and number."""
        with fleet_slip.connect(self.source, query="log") as database:
            relation = database.sql(
                "SELECT DISTINCT drive_id FROM log WHERE source <> 'scenario' ORDER BY 1"
            ).fetchall()
        return [name for (name,) in relation]

    def land(self, name: str, drives: Iterable[str], day: date, **changes: str) -> Path:
        """Write the log of some drives, on a day of your own; `changes` are columns in SQL."""
        file = self.folder / f"{name}.parquet"
        listed = ", ".join(f"'{drive}'" for drive in drives)
        changed = ", ".join(f"{sql} AS {column}" for column, sql in changes.items())
        with fleet_slip.connect(self.source, query="log") as database:
            rows = database.sql(
                f"SELECT * REPLACE (DATE '{day}' AS day{', ' if changed else ''}{changed}) "
                f"FROM log WHERE drive_id IN ({listed}) ORDER BY drive_id, time_s"
            ).to_arrow_table()
        with duckdb.connect() as writer:
            writer.register("rows", rows)
            writer.sql(f"COPY rows TO '{file}' (FORMAT parquet)")
        return file
