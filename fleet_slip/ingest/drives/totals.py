"""What became of the rows of a measured file."""

from collections import Counter
from dataclasses import dataclass, field

from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.ingest.drives.open_drives import DriveRows


@dataclass(frozen=True)
class IngestCounts:
    """What became of a file's rows.

    `rows_read == rows_left_out + rows_kept + sum(quarantined.values())`.
    """

    rows_read: int
    rows_left_out: int
    """Rows that do not meet the mapping's conditions."""
    rows_kept: int
    quarantined: dict[str, int]
    """Rejected rows by reason."""
    drives: int
    drives_resampled: int
    ticks: int
    """Rows of the result; equal to `rows_kept` where nothing was resampled."""


@dataclass
class Totals:
    """What became of a file's rows so far."""

    rows_kept: int = 0
    quarantined: Counter[str] = field(default_factory=Counter)
    refused: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Rejected rows by what is wrong, where that is a signal, and by the reason."""
    drives: int = 0
    drives_resampled: int = 0
    ticks: int = 0
    samples: Counter[str] = field(default_factory=Counter)
    """Values of each signal in the file's rows; `values` are those on ticks."""
    values: Counter[str] = field(default_factory=Counter)

    def add(self, rows: DriveRows, drive: MeasuredDrive) -> None:
        """Count a drive that was made of rows."""
        self.rows_kept += rows.height
        self.drives += 1
        self.drives_resampled += drive.method != "snap"
        self.ticks += drive.ticks.size
        for name, counts in drive.counts.items():
            self.samples[name] += rows.number_of(name)
            self.values[name] += len(counts) - counts.null_count
