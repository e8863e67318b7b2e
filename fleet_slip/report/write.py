"""Writes a report: the page, and its figures as files."""

from dataclasses import dataclass
from pathlib import Path

from fleet_slip.registry import ModelVersion
from fleet_slip.report.data import gather
from fleet_slip.report.drawing import png_file, svg_file
from fleet_slip.report.page import render
from fleet_slip.report.pictures import pictures
from fleet_slip.storage import TEMPORARY_PREFIX, storage_errors
from fleet_slip.warehouse import Warehouse

PAGE = "report.html"
FIGURES = "figures"


@dataclass(frozen=True)
class Written:
    """What was written."""

    page: Path
    size_bytes: int
    figures: int


def write_report(warehouse: Warehouse, version: ModelVersion, output: Path) -> Written:
    """Write the report about a model version into a folder.

    A file is replaced as a whole or not at all; the page comes last. Raises `SelectionError` if the
    version has not been evaluated, or not on today's data.
    """
    data = gather(warehouse, version)
    shown = pictures(data)
    page = render(data, shown).encode("utf-8")
    for picture in shown:
        _replace(output / FIGURES / f"{picture.key}.svg", svg_file(picture).encode("utf-8"))
        _replace(output / FIGURES / f"{picture.key}.png", png_file(picture))
    _replace(output / PAGE, page)
    return Written(output / PAGE, len(page), len(shown))


def _replace(file: Path, content: bytes) -> None:
    temporary = file.with_name(f"{TEMPORARY_PREFIX}{file.name}")
    with storage_errors(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(content)
            temporary.replace(file)
        finally:
            temporary.unlink(missing_ok=True)
