"""Brings measured logs in: a file and a mapping become counts at 100 Hz."""

from fleet_slip.ingest.drives.totals import IngestCounts
from fleet_slip.ingest.mapping.mapping import Mapping, load_mapping
from fleet_slip.ingest.measured import MeasuredLog, read_measured

__all__ = [
    "IngestCounts",
    "Mapping",
    "MeasuredLog",
    "load_mapping",
    "read_measured",
]
