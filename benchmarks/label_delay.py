"""How often a label that is made late is suspected, and one that is in time.

    fleet-slip --root data simulate waterford --days 1   # and other campaigns
    fleet-slip --root data gram
    python -m benchmarks.label_delay data [--drives 16]

Takes some drives of each campaign of a data root, moves the side-slip angle by a delay, and asks
`find_suspicions`.
"""

import argparse
import json
from collections.abc import Iterator

import numpy as np
import polars as pl

import fleet_slip
from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.drives.relations import MOST_TICKS
from fleet_slip.ingest.drives.suspicion import find_suspicions

DELAYS_S = (0.0, 0.05, 0.1, 0.2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("--drives", type=int, default=16, help="of each campaign")
    given = parser.parse_args()
    fleet = fleet_slip.open(given.root)
    for campaign in sorted(fleet.sql("SELECT DISTINCT campaign FROM drives").pl()["campaign"]):
        drives = list(drives_of(fleet, campaign, given.drives))
        for delay_s in DELAYS_S:
            found = [found_delay(drive, delay_s) for drive in drives]
            told = [one for one in found if one is not None]
            print(
                json.dumps(
                    {
                        "campaign": campaign,
                        "drives": len(drives),
                        "delay_s": delay_s,
                        "suspected": len(told),
                        "median_s": round(float(np.median(told)), 3) if told else None,
                    }
                ),
                flush=True,
            )


def drives_of(
    fleet: fleet_slip.Fleet, campaign: str, number: int
) -> Iterator[dict[str, FloatArray]]:
    """Yield the signals that a car logs of some drives, in SI units."""
    columns = {name: catalogue()[name].column for name in (*catalogue().inputs, catalogue().label)}
    names = fleet.sql(
        f"SELECT drive_id FROM drives WHERE campaign = '{campaign}' "
        f"ORDER BY hash(drive_id) LIMIT {number}"
    )
    for name in names.pl()["drive_id"]:
        rows = fleet.sql(
            f"SELECT {', '.join(columns.values())} FROM log WHERE drive_id = '{name}' "
            f"ORDER BY tick LIMIT {MOST_TICKS}"
        ).pl()
        yield {
            signal: rows[column].cast(pl.Float64).fill_null(float("nan")).to_numpy()
            for signal, column in columns.items()
            if rows[column].null_count() < rows.height
        }


def found_delay(drive: dict[str, FloatArray], delay_s: float) -> float | None:
    """Return the delay that is proposed once the label is made late; None if none is."""
    label = catalogue().label
    late = {**drive, label: np.roll(drive[label], round(100 * delay_s))}
    return next((one.value for one in find_suspicions(late) if one.kind == "late"), None)


if __name__ == "__main__":
    main()
