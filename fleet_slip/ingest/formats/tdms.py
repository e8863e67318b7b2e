"""Reads TDMS files of LabVIEW through npTDMS, some values at once.

Times come from the properties of waveforms. Without these, time is one of the channels. A channel
name of several groups becomes `CHANNEL@GROUP`.
"""

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from logging import CRITICAL
from typing import Any

import numpy as np
import polars as pl

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.matlab import Matrix, Vectors
from fleet_slip.ingest.formats.source import (
    EARLIEST_S,
    OWN_TIME,
    Budget,
    Channel,
    load_library,
)

READ_AHEAD = 2**17
"""Values that are read at once: for each time npTDMS reads all that a segment has of a channel."""
_SCALE = re.compile(r"NI_Scale\[\d+\]_Scale_Type")
_APPLIED = {
    "Polynomial", "Linear", "RTD", "Strain", "Table", "Thermistor", "Thermocouple", "Add",
    "Subtract", "AdvancedAPI",
}  # fmt: skip


class _Vector(Matrix):
    """The values of a channel; `base` identifies their times, empty if there are none."""

    def __init__(self, channel: Any) -> None:
        self.title = ""
        self._channel, self._first, self._ahead = channel, 0, np.zeros(0)
        properties, self.shape = channel.properties, (len(channel),)
        self.unit, self.step_s = (
            str(properties.get("unit_string", "")),
            float(properties.get("wf_increment", 0)),
        )
        began_s = np.datetime64(properties.get("wf_start_time", 0), "us").astype(np.int64) / 1e6
        offset_s = float(properties.get("wf_start_offset", 0))
        self.start_s = offset_s + (began_s if began_s > EARLIEST_S else 0.0)
        times = f"{self.start_s!r} s and each {self.step_s!r} s, {len(channel)} times"
        self.base = times if self.step_s > 0 else ""

    def read(self, _column: int, start: int, end: int) -> np.ndarray[Any, Any]:
        """Return some values, scaled."""
        if not self._first <= start <= end <= self._first + len(self._ahead):
            until = max(start + READ_AHEAD, end)
            self._first, self._ahead = start, np.asarray(self._channel[start:until])
        return self._ahead[start - self._first : end - self._first]


class TdmsSource(Vectors):
    """The waveforms of a file."""

    has_clock = True
    _matrices: dict[str, _Vector]

    def channels(self) -> list[Channel]:
        """Return the waveforms, with their units."""
        return [Channel(name, vector.unit, vector.base) for name, vector in self._matrices.items()]

    def find(self, column: str) -> tuple[str, tuple[Matrix, int]]:
        """Return the time base and the position of a column. Raises `InputError`."""
        _, place = super().find(column)
        return self._matrices[column].base, place

    def read(self, base: str, places: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield all rows, with their times."""
        wave, row = self._matrices[next(iter(places))], 0
        for rows in super().read(base, places):
            times_s = wave.start_s + wave.step_s * np.arange(row, row + rows.height)
            row += rows.height
            yield rows.with_columns(pl.Series(OWN_TIME, times_s, dtype=pl.Float64))


@contextmanager
def open_tdms(budget: Budget, _formats: FileFormats) -> Iterator[Vectors]:
    """Open a TDMS file without its index, which may belong to another file.

    Raises `InputError`, also for a file that ends too early, or has counts of a converter.
    """
    file = budget.file
    nptdms = load_library(file, "nptdms")
    with file.open("rb") as stream:
        nptdms.log.log_manager.set_level(CRITICAL)  # each of its modules has a level of its own
        tdms = nptdms.TdmsFile.open(stream)
        last = tdms._reader._segments[-1:]
        if [channel.next_segment_pos for channel in last] != [budget.size] or any(
            channel.segment_incomplete or channel.final_chunk_lengths_override is not None
            for channel in last
        ):
            raise InputError(
                f"{quote_name(file)}: its last segment ends too early: it was cut off, or is still "
                "written. Copy it again."
            )
        channels = [
            channel for group in tdms.groups() for channel in group.channels() if len(channel)
        ]
        if not channels or any(channel.scaler_data_types for channel in channels):
            problem = "has unscaled raw data of DAQmx" if channels else "has no values"
            raise InputError(
                f"{quote_name(file)}: it {problem}. Save it from LabVIEW or DIAdem, scaled."
            )
        for item in (tdms, *tdms.groups(), *channels):
            _require_scales(budget, item.properties)
        several = Counter(channel.name for channel in channels)
        vectors = {
            channel.name
            if several[channel.name] < 2
            else f"{channel.name}@{channel.group_name}": _Vector(channel)
            for channel in channels
        }
        waves = {name: channel for name, channel in vectors.items() if channel.base}
        yield TdmsSource(waves, budget, {}) if waves else Vectors(vectors, budget, {})


def _require_scales(budget: Budget, properties: Any) -> None:
    """Raise `InputError` for scales that npTDMS would leave out: it would give raw counts."""
    scales = {name: kind for name, kind in properties.items() if _SCALE.fullmatch(name)}
    odd = sorted(set(scales.values()) - _APPLIED)
    if int(properties.get("NI_Number_Of_Scales", len(scales))) != len(scales):
        odd = odd or ["another number of scales than it says"]
    if odd and properties.get("NI_Scaling_Status") != "scaled":
        raise InputError(
            f"{quote_name(budget.file)}: it has scales that are not applied: {', '.join(odd)}. "
            "Save it "
            "from LabVIEW or DIAdem, scaled."
        )
