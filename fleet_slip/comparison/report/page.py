"""The report: one static page without a request to anywhere, and its figures as files."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from fleet_slip.comparison.evaluation.targets import PAPER_TABLE_TWO
from fleet_slip.comparison.report.further_pictures import draw_pictures
from fleet_slip.comparison.report.judging import Judged, Status, judge_claims
from fleet_slip.comparison.report.report_data import ReportData, gather
from fleet_slip.comparison.report.report_tables import tables
from fleet_slip.files.folder import Folder
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.pages.drawing import Picture, draw, png_file, svg_file
from fleet_slip.pages.page_parts import Tile, count, degrees, fill_in
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of

SECTIONS = {"paper": "figure-", "roads": "road-", "fleet": "fleet-"}
"""What the keys of a section's pictures begin with."""

TABLES_IN = {
    "tables": ("table-1", "table-2", "distances", "targets", "targets-filter"),
    "further": (
        "without-label", "own-car", "scenarios", "standings", "limits", "fleets",
    ),
    "coefficients": ("coefficients",),
}  # fmt: skip
"""The tables of each section, by their names in `tables.toml`."""


def render(data: ReportData, shown: Sequence[Picture]) -> str:
    """Return the page."""
    drawn = [draw(one) for one in shown]
    claims = judge_claims(data)
    return fill_in(
        "report.html.j2",
        version=data.version,
        evaluation=data.evaluated.document,
        **{
            section: [one for one in drawn if one.picture.key.startswith(prefix)]
            for section, prefix in SECTIONS.items()
        },
        beyond=[one for one in drawn if not one.picture.key.startswith((*SECTIONS.values(),))],
        **{
            section: [one for name in names for one in tables(data, name)]
            for section, names in TABLES_IN.items()
        },
        tiles=_tiles(data, claims),
        claims=claims,
        tally=_tally(claims),
        statuses=list(Status),
        missing=[one for one in data.shipped if one not in data.evaluated.scenarios],
        provenance=_provenance(data),
        configs=data.configs,
        commands=_commands(data),
    )


def _tally(claims: Sequence[Judged]) -> dict[Status, int]:
    counted = Counter(one.status for one in claims)
    return {status: counted[status] for status in Status}


def _tiles(data: ReportData, claims: Sequence[Judged]) -> list[Tile]:
    tally = _tally(claims)
    cohort = data.trained.selection.cohort
    tiles = [
        Tile(
            f"{tally[Status.REPRODUCED]} of "
            f"{tally[Status.REPRODUCED] + tally[Status.NOT_REPRODUCED]}",
            f"testable claims reproduced; {tally[Status.NOT_TESTABLE]} cannot be tested here",
        ),
        Tile(
            count(cohort.rows),
            f"training rows of {number_of(data.version.manifest.trained_on.drives, 'drive')}",
        ),
    ]
    reported, chosen = (
        None if found is None else found.error_std_deg
        for found in (
            data.evaluated.figures("nominal", data.version.reference),
            data.evaluated.figures("nominal", data.choice),
        )
    )
    if reported is not None and chosen is not None:
        number = data.choice_number
        tiles.append(
            Tile(
                degrees(reported),
                f"error std of {data.version.reference} on the nominal drive; "
                f"of model {number} {degrees(chosen)}, in the paper "
                f"{degrees(PAPER_TABLE_TWO[number][1])}",
            )
        )
    return tiles


def _provenance(data: ReportData) -> list[tuple[str, str]]:
    manifest = data.version.manifest
    trained = manifest.trained_on
    cohort = data.trained.selection.cohort
    now = f"logs {cohort.logs_version}, grams {cohort.grams_version}"
    return [
        ("model version", data.version.reference),
        ("its SHA-256", data.version.sha256),
        ("signals", ", ".join(manifest.signals)),
        ("cohort", trained.cohort),
        ("trained on", f"{number_of(trained.drives, 'drive')}, {count(trained.rows)} rows"),
        (
            "table versions",
            f"logs {trained.logs_version}, grams {trained.grams_version} when it was published; "
            f"{now} now",
        ),
        ("model list", f"{manifest.selected_by.model_list}, {manifest.selected_by.config_sha256}"),
        ("evaluation", f"evaluations/{data.evaluated.document.number}.json"),
        ("its SHA-256", data.evaluated.document.sha256),
        ("package", f"fleet-slip {data.evaluated.document.content['package_version']}"),
    ]


def _commands(data: ReportData) -> list[str]:
    reference = data.version.reference
    fleets = dict.fromkeys(
        row["fleet"].rpartition("/")[0] for row in data.evaluated.rows("comparisons")
    )
    options = "".join(f" --fleet {name}" for name in fleets)
    return [
        *(f"fleet-slip run --campaign {name}" for name in data.campaigns),
        f"fleet-slip evaluate {reference}{options}",
        f"fleet-slip report {reference}",
    ]


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
    """Write the report into a folder, the page last. Raises `DataError` if not evaluated."""
    data = gather(warehouse, version)
    shown = draw_pictures(data)
    page = render(data, shown).encode("utf-8")
    for picture in shown:
        output.put(f"{FIGURES}/{picture.key}.svg", svg_file(picture).encode("utf-8"))
        output.put(f"{FIGURES}/{picture.key}.png", png_file(picture))
    output.put(PAGE, page)
    return Written(f"{output}/{PAGE}", len(page), len(shown))
