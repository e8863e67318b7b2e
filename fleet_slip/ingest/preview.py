"""What ingesting a file would do, and a picture of it: nothing is stored."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import polars as pl
import pyarrow.compute as pc

from fleet_slip.base import Record
from fleet_slip.catalogue.faults import Fault
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.drives import MeasuredDrive
from fleet_slip.ingest.log_files import Log, local_copy
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.stream import IngestCounts, open_measured
from fleet_slip.ingest.suspicion import Signals, find_suspicions, on_every_tick

MOST_TICKS = 200_000
"""Ticks of the longest drive that are looked at: half an hour."""


@dataclass(frozen=True)
class SignalRange:
    """The values of a signal in a file, in the catalogue's unit."""

    signal: str
    unit: str
    low: float
    high: float
    missing: float
    """Part of the ticks without a value."""


@dataclass(frozen=True)
class Preview(Record):
    """What would become of a file."""

    DOCUMENT = "file *counts ranges suspicions"

    file: str
    counts: IngestCounts
    ranges: tuple[SignalRange, ...]
    suspicions: tuple[Fault, ...]
    longest: Signals
    """The signals of the longest drive, on consecutive ticks from its first."""

    @property
    def alarms(self) -> tuple[Fault, ...]:
        """What looks wrong and does harm."""
        return tuple(one for one in self.suspicions if one.does_harm)


def preview_log(log: Log, mapping: Mapping) -> Preview:
    """Read a log through a mapping, and look at what came out. Raises `InputError`."""
    longest: MeasuredDrive | None = None
    ends: dict[str, list[int]] = {name: [] for name in mapping.signal_names}
    values: Counter[str] = Counter()
    with local_copy(log) as file, open_measured(file, mapping) as stream:
        for drive in (drive for piece in stream.pieces() for drive in piece.drives):
            if longest is None or drive.ticks.size > longest.ticks.size:
                longest = drive
            for name, counts in drive.counts.items():
                values[name] += len(counts) - counts.null_count
                found = pc.min_max(counts).as_py()
                ends[name] += [] if found["min"] is None else [found["min"], found["max"]]
        of_rows = stream.suspicions()  # which may look into the file again
    counts, signals = stream.counts, signals_of(longest) if longest is not None else {}
    ranges = []
    for name, some in ends.items():
        scale = float(catalogue()[name].scale)
        low, high = (scale * min(some), scale * max(some)) if some else (np.nan, np.nan)
        missing = 1 - values[name] / max(counts.ticks, 1)
        ranges.append(SignalRange(name, catalogue()[name].unit, low, high, missing))
    suspicions = (*of_rows, *find_suspicions(signals))
    return Preview(str(log), counts, tuple(ranges), suspicions, signals)


def signals_of(drive: MeasuredDrive) -> Signals:
    """Return the signals of the beginning of a drive, as `find_suspicions` takes them."""
    kept = drive.ticks - drive.ticks[0] < MOST_TICKS
    counts = {  # by Polars: Arrow's own would load pandas
        name: pl.Series(values).cast(pl.Float64).fill_null(float("nan")).to_numpy()[kept]
        for name, values in drive.counts.items()
    }
    return on_every_tick(drive.ticks[kept], counts)
