"""Reads TDMS files of LabVIEW through npTDMS, some values at once.

Times come from the properties of waveforms. Without these, time is one of the channels. A channel
name of several groups becomes `CHANNEL@GROUP`.
"""

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from logging import CRITICAL
from typing import Any

import numpy as np
import polars as pl

from fleet_slip.base import quote_name
from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.matlab import Vector, Vectors
from fleet_slip.ingest.formats.source import (
    EARLIEST_S,
    OWN_TIME,
    Budget,
    load_library,
)

_SCALE = re.compile(r"NI_Scale\[\d+\]_Scale_Type")
_APPLIED = {
    "Polynomial", "Linear", "RTD", "Strain", "Table", "Thermistor", "Thermocouple", "Add",
    "Subtract", "AdvancedAPI",
}  # fmt: skip


@dataclass(frozen=True)
class _Wave(Vector):
    """The values of a channel, and when the first one was taken, if `step_s` is positive."""

    start_s: float = 0.0
    step_s: float = 0.0


def _wave(channel: Any) -> _Wave:
    properties, rows = channel.properties, len(channel)
    began_s = np.datetime64(properties.get("wf_start_time", 0), "us").astype(np.int64) / 1e6
    start_s = float(properties.get("wf_start_offset", 0))
    start_s += began_s if began_s > EARLIEST_S else 0.0
    step_s = float(properties.get("wf_increment", 0))
    times = f"{start_s!r} s and each {step_s!r} s, {rows} times" if step_s > 0 else ""
    unit = str(properties.get("unit_string", ""))
    return _Wave(rows, channel.__getitem__, "", unit, times, start_s, step_s)


class TdmsSource(Vectors):
    """The waveforms of a file."""

    has_clock = True

    def read(self, base: str, waves: dict[str, Any]) -> Iterator[pl.DataFrame]:
        """Yield all rows, with their times."""
        wave, row = next(iter(waves.values())), 0
        for rows in super().read(base, waves):
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
            else f"{channel.name}@{channel.group_name}": _wave(channel)
            for channel in channels
        }
        waves = {name: wave for name, wave in vectors.items() if wave.base}
        yield TdmsSource(file, waves, {}) if waves else Vectors(file, vectors, {})


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
