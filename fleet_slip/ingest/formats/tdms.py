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

from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.matlab import Vector, Vectors
from fleet_slip.ingest.formats.source import EARLIEST_S, Budget, load_library

_SAVE = "Save it from LabVIEW or DIAdem, scaled."
_SCALE = re.compile(r"NI_Scale\[\d+\]_Scale_Type")
_APPLIED = {
    "Polynomial", "Linear", "RTD", "Strain", "Table", "Thermistor", "Thermocouple", "Add",
    "Subtract", "AdvancedAPI",
}  # fmt: skip


def _vector(channel: Any) -> Vector:
    properties = channel.properties
    began_s = np.datetime64(properties.get("wf_start_time", 0), "us").astype(np.int64) / 1e6
    start_s = float(properties.get("wf_start_offset", 0))
    start_s += began_s if began_s > EARLIEST_S else 0.0
    step_s = float(properties.get("wf_increment", 0))
    times = (float(start_s), step_s) if step_s > 0 else None
    unit = str(properties.get("unit_string", ""))
    return Vector(len(channel), channel.__getitem__, "", unit, times)


@contextmanager
def open_tdms(budget: Budget, _formats: FileFormats) -> Iterator[Vectors]:
    """Open a TDMS file without its index, which may belong to another file.

    Raises `InputError`, also for a file that ends too early, or has counts of a converter.
    """
    nptdms = load_library(budget.file, "nptdms")
    with budget.file.open("rb") as stream:
        nptdms.log.log_manager.set_level(CRITICAL)  # each of its modules has a level of its own
        tdms = nptdms.TdmsFile.open(stream)
        last = tdms._reader._segments[-1:]
        if [segment.next_segment_pos for segment in last] != [budget.size] or any(
            segment.segment_incomplete or segment.final_chunk_lengths_override is not None
            for segment in last
        ):
            raise budget.error(
                "its last segment ends too early: it was cut off, or is still written. Copy it "
                "again."
            )
        channels = [c for group in tdms.groups() for c in group.channels() if len(c)]
        if not channels or any(channel.scaler_data_types for channel in channels):
            problem = "has unscaled raw data of DAQmx" if channels else "has no values"
            raise budget.error(f"it {problem}. {_SAVE}")
        for item in (tdms, *tdms.groups(), *channels):
            _require_scales(budget, item.properties)
        vectors, several = Vectors(budget), Counter(channel.name for channel in channels)
        for channel in channels:
            suffix = f"@{channel.group_name}" if several[channel.name] > 1 else ""
            vectors.vectors[channel.name + suffix] = _vector(channel)
        waves = {name: vector for name, vector in vectors.vectors.items() if vector.times}
        if waves:
            vectors.vectors, vectors.has_clock = waves, True
        yield vectors


def _require_scales(budget: Budget, properties: Any) -> None:
    """Raise `InputError` for scales that npTDMS would leave out: it would give raw counts."""
    scales = {name: kind for name, kind in properties.items() if _SCALE.fullmatch(name)}
    odd = sorted(set(scales.values()) - _APPLIED)
    if int(properties.get("NI_Number_Of_Scales", len(scales))) != len(scales):
        odd = odd or ["another number of scales than it says"]
    if odd and properties.get("NI_Scaling_Status") != "scaled":
        raise budget.error(f"it has scales that are not applied: {', '.join(odd)}. {_SAVE}")
