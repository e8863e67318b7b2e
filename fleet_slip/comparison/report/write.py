"""Writes a report: the page, and its figures as files."""

from dataclasses import dataclass

from fleet_slip.comparison.report.findings.report_data import gather
from fleet_slip.comparison.report.page import render
from fleet_slip.comparison.report.pictures import draw_pictures
from fleet_slip.files.folder import Folder
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.pages.drawing import png_file, svg_file
from fleet_slip.warehouse.tables import Warehouse

PAGE = "report.html"
FIGURES = "figures"


@dataclass(frozen=True)
class Written:
    """What was written."""

    page: str
    size_bytes: int
    figures: int

    @property
    def figures_folder(self) -> str:
        """Where the figures are as files."""
        return f"{self.page.removesuffix(PAGE)}{FIGURES}"


def write_report(warehouse: Warehouse, version: ModelVersion, output: Folder) -> Written:
    """Write the report about a model version into a folder.

    A file is replaced as a whole or not at all; the page comes last. Raises `DataError` if the
    version has not been evaluated, or not on today's data.
    """
    data = gather(warehouse, version)
    shown = draw_pictures(data)
    page = render(data, shown).encode("utf-8")
    for picture in shown:
        output.put(f"{FIGURES}/{picture.key}.svg", svg_file(picture).encode("utf-8"))
        output.put(f"{FIGURES}/{picture.key}.png", png_file(picture))
    output.put(PAGE, page)
    return Written(f"{output}/{PAGE}", len(page), len(shown))
