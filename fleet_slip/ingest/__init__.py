"""Brings measured logs in: a file and a mapping become counts at 100 Hz."""

from fleet_slip.ingest.drives.totals import IngestCounts
from fleet_slip.ingest.mapping.mapping import Mapping, load_mapping

__all__ = [
    "IngestCounts",
    "Mapping",
    "load_mapping",
]
