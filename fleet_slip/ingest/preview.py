"""What ingesting a file would do: nothing is stored."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured import IngestCounts, MeasuredLog, read_measured
from fleet_slip.ingest.suspicion import Suspicion, find_suspicions

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
class Preview:
    """What would become of a file."""

    file: str
    counts: IngestCounts
    ranges: tuple[SignalRange, ...]
    suspicions: tuple[Suspicion, ...]
    longest: dict[str, FloatArray]
    """The signals of the longest drive, on consecutive ticks from its first."""

    def as_dict(self) -> dict[str, Any]:
        """Return what `ingest --dry-run --json` prints."""
        return {
            "file": self.file,
            **vars(self.counts),
            "ranges": [vars(one) for one in self.ranges],
            "suspicions": [vars(one) for one in self.suspicions],
        }


def preview_file(file: Path, mapping: Mapping) -> Preview:
    """Read a file through a mapping, and look at what came out. Raises `InputError`."""
    log = read_measured(file, mapping)
    ranges = tuple(_range(log.drives, name) for name in mapping.signals)
    longest = signals_of_longest_drive(log, mapping)
    return Preview(str(file), log.counts, ranges, tuple(find_suspicions(longest)), longest)


def signals_of_longest_drive(log: MeasuredLog, mapping: Mapping) -> dict[str, FloatArray]:
    """Return the signals of a log's longest drive in SI units, NaN where there is no value."""
    names = log.drives["drive_id"].combine_chunks()
    counts = pc.value_counts(names)
    longest = counts[int(np.argmax(counts.field("counts").to_numpy()))]["values"]
    rows = log.drives.filter(pc.equal(names, longest))
    ticks = rows["tick"].to_numpy()
    kept = ticks - ticks[0] < MOST_TICKS
    signals = {}
    for name in mapping.signals:
        values = np.full(int(ticks[kept][-1] - ticks[0]) + 1, np.nan)
        counts_of = pc.cast(rows[name], pa.float64()).to_numpy()
        values[ticks[kept] - ticks[0]] = counts_of[kept] * float(catalogue()[name].scale)
        signals[name] = values
    return signals


def _range(drives: pa.Table, name: str) -> SignalRange:
    signal, column = catalogue()[name], drives[name]
    found = pc.min_max(column).as_py()
    low, high = (
        np.nan if found[key] is None else found[key] * float(signal.scale) for key in ("min", "max")
    )
    return SignalRange(name, signal.unit, low, high, column.null_count / max(len(column), 1))
