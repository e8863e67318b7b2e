"""What became of a file's rows, and when that says that the file or its mapping is not usable."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.drives.measured_drives import MeasuredDrive
from fleet_slip.ingest.drives.open_drives import DriveRows
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.words import number_of, shown

MAX_DRIVES = 10_000
"""Short drives in one file. With more, time or the drive's column is not what the mapping says."""
SHORT_ROWS = 1000
MAX_TICKS = 40_000_000
"""Ticks of all drives of one file together, where it has few rows for so many."""
MOST_TICKS_A_ROW = 1000


@dataclass(frozen=True)
class IngestCounts:
    """What became of a file's rows: read are left out, kept or quarantined."""

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

    def without(self, drives: int, ticks: int) -> "IngestCounts":
        """Return the counts where some drives were left out, and so many ticks are left."""
        return replace(self, drives=self.drives - drives, ticks=ticks)


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
    first_refused: dict[str, Any] | None = None

    def add(self, rows: DriveRows, drive: MeasuredDrive) -> None:
        """Count a drive that was made of rows."""
        self.rows_kept += rows.height
        self.drives += 1
        self.drives_resampled += drive.method != "snap"
        self.ticks += drive.ticks.size
        for name, counts in drive.counts.items():
            self.samples[name] += rows.number_of(name)
            self.values[name] += len(counts) - counts.null_count

    def add_refused(self, refused: pl.DataFrame, signals: Collection[str]) -> None:
        """Count refused rows, by reason and, where that is one of the signals, by what is wrong."""
        if refused.height:
            self.quarantined.update(refused["reason"])
            of_signals = refused.filter(pl.col("signal").is_in(list(signals)))
            self.refused.update(zip(of_signals["signal"], of_signals["reason"], strict=True))
            first = refused.row(refused["row"].arg_min() or 0, named=True)
            self.first_refused = min(self.first_refused or first, first, key=lambda r: r["row"])

    def counts(self, rows_read: int, rows_left_out: int) -> IngestCounts:
        """Return what became of the rows, of which so many were read and left out."""
        return IngestCounts(
            rows_read=rows_read,
            rows_left_out=rows_left_out,
            rows_kept=self.rows_kept,
            quarantined=dict(sorted(self.quarantined.items())),
            drives=self.drives,
            drives_resampled=self.drives_resampled,
            ticks=self.ticks,
        )

    def require_sane_drives(self, file: Path, mapping: Mapping) -> None:
        """Raise `InputError` where drives are too many or too long for so few rows."""
        if self.drives > MAX_DRIVES and self.rows_kept < SHORT_ROWS * self.drives:
            raise InputError(
                f"{shown(file)}: it falls into more than {MAX_DRIVES:,} drives, of "
                f"{self.rows_kept / self.drives:.0f} rows on average. Check time, split_gap_s "
                f"and the drive's column in the mapping {mapping.name!r}."
            )
        if self.ticks > MAX_TICKS and self.ticks > MOST_TICKS_A_ROW * self.rows_kept:
            raise InputError(
                f"{shown(file)}: {self.rows_kept:,} rows last {self.ticks:,} ticks of "
                "100 Hz. Check the unit of time and split_gap_s in the mapping "
                f"{mapping.name!r}."
            )

    def require_usable(self, file: Path, mapping: Mapping) -> None:
        """Raise `InputError` where no row, no tick, or no value of a signal came of all rows."""
        if not self.rows_kept and self.first_refused is not None:
            reasons = ", ".join(f"{n:,} {reason}" for reason, n in self.quarantined.most_common())
            first = self.first_refused
            example = f"{first['signal'] or 'the row'} = {first['value']!r} in row {first['row']}"
            raise InputError(
                f"{shown(file)}: none of its "
                f"{number_of(self.quarantined.total(), 'row')} is usable ({reasons}; first: "
                f"{example}). Check columns, units and time in the mapping {mapping.name!r}."
            )
        if not self.ticks:
            raise InputError(
                f"{shown(file)}: no row is on a tick of 100 Hz, and longest_gap_s = "
                f"{mapping.time.longest_gap_s:g} forbids to interpolate. Raise it in the "
                f"mapping {mapping.name!r} if the signals change slowly enough."
            )
        for signal, source in mapping.signals.items():
            if self.samples[signal] and not self.values[signal]:
                raise InputError(
                    f"{shown(file)}: {signal} has "
                    f"{number_of(self.samples[signal], 'value')} in {source.column!r}, and none "
                    "is on a tick of 100 Hz: they are further apart than longest_gap_s. Give the "
                    f"signal in the mapping {mapping.name!r} a longest_gap_s of its own, or "
                    "interpolate = false."
                )
