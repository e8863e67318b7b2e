"""Which figures a report has, with their captions from the same data."""

from fleet_slip.comparison.report.findings.report_data import ReportData
from fleet_slip.comparison.report.pictures.further_pictures import (
    fleet_pictures,
    further_pictures,
    road_pictures,
)
from fleet_slip.comparison.report.pictures.memory_pictures import memory_pictures
from fleet_slip.comparison.report.pictures.paper_pictures import paper_pictures
from fleet_slip.pages.picture import Picture


def draw_pictures(data: ReportData) -> tuple[Picture, ...]:
    """Return all figures whose drives were evaluated."""
    parts = (paper_pictures, further_pictures, memory_pictures, road_pictures, fleet_pictures)
    return tuple(picture for part in parts for picture in part(data))
