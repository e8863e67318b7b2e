"""Ingests a Parquet lake of CAN messages, one file a message and session, and measures it.

python -m benchmarks.message_lake --sessions 1000 --messages 20
"""

import argparse
import resource
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl

import fleet_slip

MAPPING = """name = "lake"
[time]
own_clock = true
[drive]
vehicle_id = { path = "{}/*" }
vehicle_model = "s"
[signals]
ax = { column = "CAN1_M0/a", unit = "m/s^2" }
ay = { column = "CAN1_M1/a", unit = "m/s^2" }
yaw_rate = { column = "CAN1_M2/a", unit = "deg/s" }
steering_wheel = { column = "CAN1_M3/a", unit = "deg" }
"""
SECONDS = 10.0
DEVICES = 10


def write_lake(folder: Path, sessions: int, messages: int) -> None:
    """Write sessions of 10 s; a message has two columns at 50 Hz."""
    rng = np.random.default_rng(0)
    time_us = (np.arange(0, SECONDS, 0.02) * 1e6).astype(np.int64)
    for session in range(sessions):
        start = datetime(2024, 6, 3, tzinfo=UTC) + timedelta(minutes=5 * session)
        device = f"{session % DEVICES:08X}"
        for number in range(messages):
            moments = pl.Series("t", time_us + round(start.timestamp() * 1e6) + 100 * number)
            columns = {key: rng.normal(size=time_us.size) for key in ("a", "b")}
            file = folder / device / f"CAN1_M{number}" / f"{start:%Y/%m/%d}"
            file.mkdir(parents=True, exist_ok=True)
            table = pl.DataFrame({"t": moments.cast(pl.Datetime("us", "UTC")), **columns})
            table.write_parquet(file / f"{session:08}_00000001.parquet")


def main() -> None:
    """Write a lake, ingest it, and print its size, the time and the peak of memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--messages", type=int, default=20)
    options = parser.parse_args()
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_lake(folder / "lake", options.sessions, options.messages)
        (folder / "lake.toml").write_text(MAPPING)
        before_s = time.process_time()
        reports = fleet_slip.open(folder / "root").ingest(
            folder / "lake", str(folder / "lake.toml")
        )
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rows = sum(report.counts.ticks for report in reports)
        print(
            f"{options.sessions * options.messages:,} files, {len(reports):,} sessions, {rows:,} "
            f"rows: {time.process_time() - before_s:.1f} s of processor time, peak {peak:,.0f} MiB"
        )


if __name__ == "__main__":
    main()
