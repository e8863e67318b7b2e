"""A report from end to end: its numbers are those of the evaluation, and it stands by itself."""

import re
import shutil
from collections import Counter
from copy import deepcopy
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jinja2 import meta

from fleet_slip.catalogue.features import features
from fleet_slip.config import config_names
from fleet_slip.errors import DataError
from fleet_slip.evaluation.charts import opening
from fleet_slip.evaluation.evaluate import LEAST_COVERAGE, evaluations_of, gates_of, keep
from fleet_slip.evaluation.pictures import draw_pictures, road_pictures
from fleet_slip.evaluation.report import (
    CLAIMS,
    LIMITS,
    NAMES,
    Facts,
    Status,
    judge,
    judge_claims,
    render,
)
from fleet_slip.evaluation.report_data import ReportData, blocks_won, difference
from fleet_slip.evaluation.report_tables import TEXTS, tables
from fleet_slip.evaluation.scenarios import PAPER_TABLE_TWO
from fleet_slip.models.manifest import LearnedFrom
from fleet_slip.models.request import CandidateModel
from fleet_slip.models.select import validate
from fleet_slip.pages.drawing import DESK, PHONE, png_file, svg_file
from fleet_slip.pages.page import degrees, number
from fleet_slip.storage.documents import Document
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
from tests.support.commands import RunCommand
from tests.support.reported import Reported, call

MINUS = "\N{MINUS SIGN}"


class Page(HTMLParser):
    """The names, links and sources of a page, and how often each element stands in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.sources: list[str] = []
        self.elements: Counter[str] = Counter()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements[tag] += 1
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name in ("href", "xlink:href"):
                (self.links if tag == "a" else self.sources).append(value or "")
            elif name in ("src", "srcset", "data", "poster"):
                self.sources.append(value or "")


@pytest.fixture(scope="module")
def page(reported: Reported) -> Page:
    return Page(reported.page.read_text(encoding="utf-8"))


def test_the_page_is_small_and_asks_for_nothing(reported: Reported, page: Page) -> None:
    assert reported.page.stat().st_size < 3_000_000
    assert all(source.startswith(("#", "data:")) for source in page.sources)
    text = reported.page.read_text(encoding="utf-8")
    assert not re.findall(r"@import|url\((?!#)", text)
    assert page.elements["script"] == 0


def test_every_link_leads_somewhere(page: Page) -> None:
    assert not [name for name, times in Counter(page.ids).items() if times > 1]
    for link in page.links:  # within the page, which may have been mailed
        assert link.startswith("#")
        assert link[1:] in page.ids


def test_each_figure_is_on_the_page_and_in_two_files(reported: Reported, page: Page) -> None:
    svgs = sorted(file.stem for file in reported.figures.glob("*.svg"))
    assert svgs == sorted(file.stem for file in reported.figures.glob("*.png"))
    assert set(svgs) >= {"figure-1a", "figure-1b", "figure-2", "figure-3", "figure-5", "figure-8"}
    assert set(svgs) <= set(page.ids)
    assert page.elements["figure"] == len(svgs)
    assert page.elements["svg"] == 2 * len(svgs)


def test_a_scenario_that_was_left_out_is_said(reported: Reported, page: Page) -> None:
    assert "figure-7" not in page.ids
    assert "melbourne" in reported.page.read_text(encoding="utf-8")


def test_the_same_data_give_the_same_bytes(reported: Reported, data: ReportData) -> None:
    """Gathered and drawn once more, in another process where tests run in several."""
    shown = draw_pictures(data)
    assert render(data, shown) == reported.page.read_text(encoding="utf-8")
    points = next(picture for picture in shown if picture.key == "test-drives")
    assert png_file(points) == (reported.figures / "test-drives.png").read_bytes()
    assert svg_file(points) == (reported.figures / "test-drives.svg").read_text(encoding="utf-8")


def test_table_one_shows_folds_by_drive_and_by_whole_bands_of_speed(data: ReportData) -> None:
    selection = data.trained.selection
    bands = selection.cohort.folds("speed", selection.folds.count)
    (table,) = tables(data, "table-1")
    assert table.head[-2:] == ["by speed", "RMSE by speed"]
    for row, model in zip(table.rows, selection.models, strict=True):
        again = validate(CandidateModel(name="x", signals=model.signals), bands)
        assert row[3].text == number(model.correlation, 4)
        assert [cell.text for cell in row[-2:]] == [
            number(again.correlation, 4),
            degrees(again.pooled.rmse_deg),
        ]
        assert row[-1].text != row[-3].text
    (bare,) = tables(replace(data, by_speed={}), "table-1")
    assert {len(row) for row in bare.rows} == {len(bare.head)} == {len(table.head) - 2}


def test_the_distances_are_those_of_every_nested_model_and_the_null_one(data: ReportData) -> None:
    (table,) = tables(data, "distances")
    assert [row[0].text for row in table.rows] == [str(j) for j in range(len(table.rows))]
    assert len(table.rows) == 1 + len(data.trained.selection.models[-1].signals)
    assert table.rows[0][1].text == "none"
    assert table.rows[-1][3].text == "0.0"
    expected = [float(row[4].text.replace(MINUS, "-")) for row in table.rows]
    (least,) = [j for j, row in enumerate(table.rows) if row[4].mark == "good"]
    assert expected[least] == min(expected)
    assert not tables(replace(data, distances="too few drives"), "distances")


def test_table_two_has_the_evaluations_numbers(data: ReportData) -> None:
    rows = tables(data, "table-2")[0].rows
    assert [row[0].text for row in rows] == ["1", "2", "3", "4", "5"]
    for row in rows:
        estimator = data.evaluated.models[row[0].text]
        found = data.evaluated.scenarios["nominal"]["results"][estimator]
        assert row[2].text == number(found["error_mean_deg"], 4, sign=True)
        assert row[4].text == number(found["error_std_deg"], 4)
        assert (row[4].mark == "good") == (
            found["error_std_deg"] <= PAPER_TABLE_TWO[row[0].text][1]
        )


def test_the_published_coefficients_are_in_the_table(data: ReportData) -> None:
    manifest = data.version.manifest
    published = data.coefficients[-1]
    values = {row.estimate.name: row.estimate.value for row in published.rows}
    assert published.model == data.version.reference
    assert values.pop("intercept") == pytest.approx(manifest.intercept, rel=1e-12)
    assert values == pytest.approx(
        {term.signal: term.coefficient for term in manifest.terms}, rel=1e-12
    )
    assert all(row.estimate.standard_error > 0 for row in published.rows)


def test_the_errors_of_blocks_add_up(data: ReportData) -> None:
    run = data.runs["nominal"]
    won = blocks_won(run, list(data.evaluated.models.values()))
    assert sum(won.values()) == len(run.drive.time_s) // 500
    better = difference(run, data.evaluated.models["4"], data.evaluated.models["1"])
    assert better.t > 0
    assert better.p < 0.01
    worse = difference(run, data.evaluated.models["1"], data.evaluated.models["4"])
    assert worse.t == pytest.approx(-better.t)


def changed(data: ReportData, content: Any) -> ReportData:
    document = Document(data.evaluated.document.number, content, "")
    return replace(data, evaluated=replace(data.evaluated, document=document))


NOISE_IS_SLIGHT = CLAIMS["noise_is_slight"]


def test_claims_name_nothing_but_scenarios_facts_and_limits() -> None:
    """A scenario that is misspelt would pass for one that was not evaluated."""
    known = {*NAMES, *LIMITS, *config_names("scenarios")}
    for claim in CLAIMS.values():
        texts = (claim.criterion, f"{{{{ {claim.holds} }}}}", claim.figure, claim.why)
        for text in texts:
            assert meta.find_undeclared_variables(TEXTS.parse(text)) <= known, text


def test_every_claim_is_judged(data: ReportData) -> None:
    verdicts = judge_claims(data)
    assert len(verdicts) == len(CLAIMS)
    assert len({one.claim.statement for one in verdicts}) == len(CLAIMS)
    for one in verdicts:
        assert one.why
        assert bool(one.figure) == (one.status is not Status.NOT_TESTABLE)


def test_a_verdict_follows_from_the_figures(data: ReportData) -> None:
    assert judge(NOISE_IS_SLIGHT, Facts(data)).status is Status.NOT_REPRODUCED
    content = deepcopy(dict(data.evaluated.document.content))
    (noisy,) = (one for one in content["scenarios"] if one["name"] == "noise_doubled")
    noisy["results"][data.choice]["rmse_deg"] = 0.1
    verdict = judge(NOISE_IS_SLIGHT, Facts(changed(data, content)))
    assert verdict.status is Status.REPRODUCED
    assert "0.100°" in verdict.figure


def test_a_claim_without_its_drives_is_not_judged(data: ReportData) -> None:
    content = deepcopy(dict(data.evaluated.document.content))
    content["scenarios"] = [one for one in content["scenarios"] if one["name"] == "nominal"]
    verdict = judge(NOISE_IS_SLIGHT, Facts(changed(data, content)))
    assert verdict.status is Status.NOT_TESTABLE
    assert "noise_doubled" in verdict.why
    assert "fleet-slip evaluate" in verdict.why


def test_an_evaluation_of_other_data_is_refused(reported: Reported, data: ReportData) -> None:
    for path, told in (
        (("estimators", data.choice, "intercept"), "cohort"),
        (("scenarios", 0, "results", data.choice, "rmse_deg"), "drive of"),
    ):
        copy = reported.root.with_name(f"copy-{told.partition(' ')[0]}")
        shutil.copytree(reported.root, copy, dirs_exist_ok=True)
        content = deepcopy(dict(data.evaluated.document.content))
        place: Any = content
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] += 0.001
        keep(evaluations_of(Warehouse(LocalFolder(copy))), content)
        with pytest.raises(DataError, match=f"{told}.* has changed since evaluation 2"):
            call(copy, "report", "smoke")


def test_a_model_that_was_not_evaluated_is_told(
    reported: Reported, run_command: RunCommand, tmp_path: Path
) -> None:
    shutil.copytree(reported.root / "models", tmp_path / "data" / "models")
    done = run_command("report", "smoke")
    assert done.exit_code == 5
    assert "fleet-slip evaluate smoke@1" in done.stderr


def test_the_standings_mark_the_smallest_error_of_each_drive(data: ReportData) -> None:
    (shown,) = tables(data, "standings")
    names = shown.head[1:]
    for drive, *cells in shown.rows:
        found = {name: data.evaluated.figures(drive.text, name) for name in names}
        errors = {
            name: one.rmse_deg
            for name, one in found.items()
            if one and one.rmse_deg is not None and one.coverage >= LEAST_COVERAGE
        }
        marked = [name for name, cell in zip(names, cells, strict=True) if cell.mark == "good"]
        least = min(errors.values())
        assert marked == [name for name in names if errors.get(name) == least]


def test_errors_stand_beside_the_bound_of_their_drive(data: ReportData) -> None:
    (shown,) = tables(data, "limits")
    assert shown.head[:3] == ["test drive", "bound, degrees", "told the car"]
    nominal = next(cells for drive, *cells in shown.rows if drive.text == "nominal")
    bound, told, *times = (float(cell.text) for cell in nominal)
    assert told < bound < 0.02
    for name, found in zip(shown.head[3:], times, strict=True):
        one = data.evaluated.figures("nominal", name)
        assert one is not None
        assert one.rmse_deg is not None
        assert found == pytest.approx(one.rmse_deg / bound, abs=0.06)


def test_every_estimator_has_a_point_on_every_test_drive(data: ReportData) -> None:
    (picture,) = [one for one in draw_pictures(data) if one.key == "test-drives"]
    names = tables(data, "standings")[0].head[1:]
    for size in (DESK, PHONE):
        (axes,) = picture.draw(size).axes
        drawn = [
            (float(x), int(y))
            for line in axes.get_lines()
            for x, y in zip(*map(np.asarray, line.get_data()), strict=True)
        ]
        expected = [
            (one.rmse_deg, place)
            for place, drive in enumerate(data.evaluated.scenarios)
            for name in names
            if (one := data.evaluated.figures(drive, name))
            and one.rmse_deg is not None
            and one.coverage >= LEAST_COVERAGE
        ]
        assert sorted(drawn) == sorted(expected)
        own = next(one for one in axes.get_lines() if one.get_label() == data.version.reference)
        places = [np.asarray(own.get_xdata())[i] for i in range(len(data.evaluated.scenarios))]
        for place, drive in zip(places, data.evaluated.scenarios, strict=True):
            found = data.evaluated.figures(drive, data.version.reference)
            assert found is not None
            assert place == found.rmse_deg


def test_gates_are_found_in_a_manifest_with_all_their_knots(data: ReportData) -> None:
    """Weights at the knots of what opens a gate, on the slippery drive: closed, then open."""
    known = features()
    members = known.members("excess")
    terms = tuple(
        data.version.manifest.terms[0].model_copy(
            update={"signal": name, "definition": known.definition(name)}
        )
        for name in members
    )
    manifest = data.version.manifest.model_copy(update={"terms": terms})
    ((name, (by, knots)),) = gates_of(manifest).items()
    assert name == "steering_excess over 32 ticks"
    assert [float(count * known.of("steering_excess_mean_32").scale) for count in knots] == [
        float(knot) for knot in known.gates["excess"].knots
    ]
    (share,) = opening(manifest, data.runs["adhesion_0_4"]).values()
    assert by.ticks == 32
    assert np.nanmin(share) == 0.0
    assert np.nanmax(share) == 1.0
    assert [one.key for one in road_pictures(data)] == []
    gated = replace(data, version=replace(data.version, manifest=manifest))
    (picture,) = road_pictures(gated)
    assert picture.draw(DESK).axes[1].get_title() == f"gate by {name}"


def test_what_no_label_taught_says_so(data: ReportData) -> None:
    assert not tables(data, "without-label")
    learned = LearnedFrom(
        label="course",
        change_s=(2.0, 4.0),
        cars=7,
        intercept_uncertainty_deg=0.012,
        intercept_spread_deg=0.034,
    )
    manifest = data.version.manifest.model_copy(update={"learned_from": learned})
    page = render(replace(data, version=replace(data.version, manifest=manifest)), [])
    assert "Learned from the course" in page and "No reference sensor" in page and "2, 4" in page
    assert degrees(0.012) in page and degrees(0.034) in page
