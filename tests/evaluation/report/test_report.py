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
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_slip.errors import DataError
from fleet_slip.evaluation.charts import band, draw_pictures
from fleet_slip.evaluation.claims import (
    CLAIMS,
    PAPER_TABLE_TWO,
    Status,
    blocks_won,
    compare_errors,
    evaluate_claim,
    generally_able,
    many_vehicles,
    noise_is_slight,
)
from fleet_slip.evaluation.evaluation_document import ReportData, evaluations_of, store_evaluation
from fleet_slip.evaluation.evaluator import ErrorStatistics
from fleet_slip.evaluation.report import render, table_two
from fleet_slip.pages.page import Cell, draw, number
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.storage.documents import Document
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import Finished, RunCommand, done_on, run
from tests.support.measured import ingest_own
from tests.support.reported import Reported, call


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


def test_the_page_is_small_and_makes_no_request(reported: Reported, page: Page) -> None:
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
    assert page.elements["svg"] == len(svgs)


def test_missing_scenarios_are_listed(reported: Reported, page: Page) -> None:
    assert "figure-7" not in page.ids
    assert "melbourne" in reported.page.read_text(encoding="utf-8")


def test_the_same_data_give_the_same_bytes(reported: Reported, data: ReportData) -> None:
    """Gathered and drawn once more, in another process where tests run in several."""
    page, figures = (
        reported.page.read_text(encoding="utf-8"),
        '(?s)<section id="figures">.*?</section>',
    )
    links = r'<a href="#figure-[^"]*">(.*?)</a>'
    without = re.sub(links, r"\1", re.sub(figures, "", page))
    assert re.sub(figures, "", render(data, ())) == without != page
    first = draw(next(draw_pictures(data)))
    assert first.svg in page
    assert first.png_file == (reported.figures / "figure-1a.png").read_bytes()
    assert first.svg_file == (reported.figures / "figure-1a.svg").read_text(encoding="utf-8")


def is_good(cell: str) -> bool:
    return isinstance(cell, Cell) and cell.mark == "good"


def test_table_two_has_the_evaluations_numbers(data: ReportData) -> None:
    rows = table_two(data).rows
    assert [row[0] for row in rows] == ["1", "2", "3", "4", "5"]
    for row in rows:
        estimator = data.models[row[0]]
        result = data.scenarios["nominal"]["results"][estimator]
        assert row[2] == number(result["error_mean_deg"], 4, sign=True)
        assert row[4] == number(result["error_std_deg"], 4)
        assert is_good(row[4]) == (result["error_std_deg"] <= PAPER_TABLE_TWO[row[0]][1])


def test_the_errors_of_blocks_add_up(data: ReportData) -> None:
    run = data.runs["nominal"]
    won = blocks_won(run, list(data.models.values()))
    assert sum(won) == len(run.drive.time_s) // 500
    t, p = compare_errors(run, data.models["4"], data.models["1"])
    assert t > 0
    assert p < 0.01
    worse, _ = compare_errors(run, data.models["1"], data.models["4"])
    assert worse == pytest.approx(-t)


def changed(data: ReportData, content: Any) -> ReportData:
    return replace(data, document=Document(data.document.number, content, ""))


def test_claims_name_scenarios_that_ship(data: ReportData, monkeypatch: pytest.MonkeyPatch) -> None:
    """A misspelt scenario would pass for one that was not evaluated."""
    names: set[str] = set()

    def statistics(_: object, scenario: str, *__: object) -> ErrorStatistics:
        names.add(scenario)
        return ErrorStatistics(*(1.0,) * 10)  # type: ignore[arg-type]

    class Everything(dict[str, Any]):
        """The document of a drive, and of any other."""

        def __getitem__(self, name: str) -> Any:
            names.add(name)
            return super().__getitem__("nominal")

    everything = replace(data)
    everything.__dict__["scenarios"] = Everything(data.scenarios)
    monkeypatch.setattr(ReportData, "statistics", statistics)
    verdicts = [evaluate_claim(claim, everything) for claim in CLAIMS]
    assert {"melbourne", "mass_1000", "tyres_soft", "car_rear_drive_sedan"} <= names
    assert names <= {*SHIPPED_CONFIGS.names("scenarios")}
    untested = [v.claim for v in verdicts if "The evaluation has no" in v.why]
    assert untested == [many_vehicles, generally_able], "no fleet, and no drive beyond the paper"


def test_every_claim_has_a_verdict(data: ReportData) -> None:
    verdicts = [evaluate_claim(claim, data) for claim in CLAIMS]
    assert len(verdicts) == len(CLAIMS) == 27
    assert len({verdict.claim.statement for verdict in verdicts}) == len(CLAIMS)
    for verdict in verdicts:
        assert verdict.why
        assert bool(verdict.figure) == (verdict.status is not Status.NOT_TESTABLE)


def test_a_verdict_follows_from_the_figures(data: ReportData) -> None:
    assert evaluate_claim(noise_is_slight, data).status is Status.NOT_REPRODUCED
    content = deepcopy(dict(data.document.content))
    (noisy,) = (
        scenario for scenario in content["scenarios"] if scenario["name"] == "noise_doubled"
    )
    noisy["results"][data.choice]["rmse_deg"] = 0.1
    verdict = evaluate_claim(noise_is_slight, changed(data, content))
    assert verdict.status is Status.REPRODUCED
    assert "0.100°" in verdict.figure


def test_a_claim_without_its_drives_is_not_testable(data: ReportData) -> None:
    content = deepcopy(dict(data.document.content))
    content["scenarios"] = [
        scenario for scenario in content["scenarios"] if scenario["name"] == "nominal"
    ]
    verdict = evaluate_claim(noise_is_slight, changed(data, content))
    assert verdict.status is Status.NOT_TESTABLE
    assert "noise_doubled" in verdict.why
    assert "fleet-slip evaluate" in verdict.why


def test_an_evaluation_of_other_data_is_refused(reported: Reported, data: ReportData) -> None:
    for path, message in (
        (("estimators", data.choice, "intercept"), "cohort"),
        (("scenarios", 0, "results", data.choice, "rmse_deg"), "drive of"),
    ):
        copy = reported.root.with_name(f"copy-{message.partition(' ')[0]}")
        shutil.copytree(reported.root, copy, dirs_exist_ok=True)
        content = deepcopy(dict(data.document.content))
        place: Any = content
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] += 0.001
        store_evaluation(evaluations_of(Warehouse(LocalFolder(copy))), content)
        with pytest.raises(DataError, match=f"{message}.* has changed since evaluation 2"):
            call(copy, "report", "smoke")


def test_a_report_requires_an_evaluation(
    reported: Reported, run_command: RunCommand, tmp_path: Path
) -> None:
    shutil.copytree(reported.root / "models", tmp_path / "data" / "models")
    done = run_command("report", "smoke")
    assert done.exit_code == 5
    assert "fleet-slip evaluate smoke@1" in done.stderr


@given(
    arrays(np.float64, st.integers(1, 300), elements=st.floats(-10, 10)),
    st.integers(1, 40),
)
def test_a_band_contains_every_sample(values: np.ndarray, bins: int) -> None:
    x = np.arange(len(values), dtype=np.float64)
    limits = band(x, values, bins)
    assert len(limits["x"]) <= bins
    assert limits["low"].min() == values.min()
    assert limits["high"].max() == values.max()
    assert (limits["low"] <= limits["mean"] + 1e-9).all()
    assert (limits["mean"] <= limits["high"] + 1e-9).all()


def test_a_band_has_a_gap_where_there_is_no_value() -> None:
    values = np.array([1.0, 2.0, np.nan, np.nan, 5.0])
    limits = band(np.arange(5.0), values, 3)
    np.testing.assert_array_equal(limits["mean"], [1.5, np.nan, 5.0])
    np.testing.assert_array_equal(limits["x"], [0.5, 2.5, 4.0])


NOTEBOOK = Path(__file__).parents[3] / "jobs/explore.py"


def executed(root: Path, folder: Path) -> tuple[int, str, str]:
    """Return the exit code, what was said, and the page."""
    program = shutil.which("marimo")
    assert program
    page, notebook = folder / "explore.html", folder / "explore.py"
    shutil.copy(NOTEBOOK, notebook)  # marimo keeps something beside it
    words = ["export", "html", str(notebook), "--output", str(page), "--", "--root", str(root)]
    done = run([program, *words])
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    return done.exit_code, done.stderr, text


@pytest.mark.tools("marimo")
def test_every_cell_works_on_a_root_with_a_model(smoke_root: Path, tmp_path: Path) -> None:
    code, output, page = executed(smoke_root, tmp_path)
    assert code == 0, output
    assert "8 drives" in page
    assert re.search(r"Coefficients over .{0,20}1 version of smoke", page)
    assert "image/png" in page


@pytest.mark.tools("marimo")
def test_without_a_model_the_notebook_states_it(smoke_root: Path, tmp_path: Path) -> None:
    ignored = shutil.ignore_patterns("models", "runs")
    root = shutil.copytree(smoke_root, tmp_path / "data", ignore=ignored)
    code, output, page = executed(root, tmp_path)
    assert code == 0, output
    assert "No model yet" in page


@pytest.fixture(scope="module")
def judged(reported: Reported, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Finished]:
    """A data root with a model of such drives, and what its evaluation said."""
    folder = tmp_path_factory.mktemp("own")
    root = Path(shutil.copytree(reported.root, folder / "data"))
    ingest_own(root, folder, cars=5)
    done_on(root, "publish", "own", "--cohort", "source = 'measured'")
    return root, done_on(root, "evaluate", "own", "--scenario", "nominal")


@pytest.mark.long
def test_filters_that_cannot_be_tuned_are_reported_and_compete(
    judged: tuple[Path, Finished],
) -> None:
    _, done = judged
    assert "kalman left untuned: the drive has no GPS fix" in done.stderr
    assert "ekf_class left untuned" in done.stderr
    assert "nominal" in done.stdout


@pytest.mark.long
def test_the_report_of_a_model_with_few_signals(judged: tuple[Path, Finished]) -> None:
    root, _ = judged
    done_on(root, "report", "own")
    page = (root / "report" / "report.html").read_text()
    assert 'lack signals of model 2, 3, 4 and 5 of <a href="#table-1">Table I</a>' in page
    assert 'id="table-1"' in page
