"""Records of benchmarks, and figures of pages: what takes a fifth longer, or is wrong, is named."""

import re
from pathlib import Path

import pytest

from tests.support.bench_record import (
    PageFigure,
    Record,
    add_record,
    draw,
    page_figures,
    read_records,
    slower_than,
)


def test_what_takes_longer_in_yardsticks_is_named(tmp_path: Path) -> None:
    file = tmp_path / "figures" / "bench.jsonl"
    assert not read_records(file)
    for speed in (1.0, 2.0, 1.0, 8.0):
        record = Record("abc", "start", 10.0 * speed, speed)
        assert slower_than(read_records(file), record) is None
        add_record(file, record)
    assert slower_than(read_records(file), Record("d", "start", 11.9, 1.0)) is None
    told = slower_than(read_records(file), Record("d", "start", 12.1, 1.0))
    assert told is not None and told.startswith("start: 12.1 s of processors, 1.21 times")
    assert slower_than(read_records(file), Record("d", "another", 99.0, 1.0)) is None


def test_records_are_drawn_over_the_commits_they_are_of(tmp_path: Path) -> None:
    records = [
        Record(commit, command, 10.0, 1.0)
        for commit in ("0abc1", "9def2+")
        for command in ("start", "encoding --copies 1")
    ]
    draw(records, tmp_path / "bench.svg")
    drawn = (tmp_path / "bench.svg").read_text("utf-8")
    for text in ("0abc1", "9def2+", "start", "encoding"):
        assert drawn.count(f"<!-- {text}") == 1


HERE = Path(__file__).parents[2]
PAGE = """# A page
It takes 1,200 ms <!-- bench made_up: number 1 after "all of it", yardstick 2.0 s -->.

| what | ns | ratio |
| sum | 50 | 0.50 <!-- bench made_up: number 2 after "| sum" --> |
"""


def made_up(folder: Path, page: str = PAGE) -> list[PageFigure]:
    (folder / "page.md").write_text(page, encoding="utf-8")
    return list(page_figures([folder / "page.md"]))


def departures(figures: list[PageFigure], output: str, yardstick_s: float) -> list[str]:
    return [told for one in figures if (told := one.departure(output, yardstick_s))]


def test_what_departs_by_more_than_a_fifth_is_named_by_page_line_and_figures(
    tmp_path: Path,
) -> None:
    figures = made_up(tmp_path)
    assert [one.written for one in figures] == [1200, 0.5]
    for within in ("1,430 ms\n| sum | 9 | 0.59 |", "970 ms\n| sum | 9 | 0.41 |"):
        assert not departures(figures, f"all of it {within}", 2.0)
    took, ratio = departures(figures, "all of it 1,450 ms\n| sum | 9 | 0.39 |", 2.0)
    assert took.startswith("page.md:2: 1200 is written, but made_up gives 1450 ('all of it', as")
    assert ratio.startswith("page.md:5: 0.5 is written, but made_up gives 0.39 ('| sum', as")


def test_processor_time_is_compared_in_yardsticks_and_a_ratio_is_not(tmp_path: Path) -> None:
    figures = made_up(tmp_path)
    assert not departures(figures, "all of it 4,800 ms\n| sum | 200 | 0.5 |", 8.0)
    took, ratio = departures(figures, "all of it 1,200 ms\n| sum | 50 | 2.0 |", 8.0)
    assert "page.md:2" in took and "gives 300 " in took
    assert "page.md:5" in ratio and "gives 2 " in ratio


def test_a_figure_that_is_no_longer_printed_is_named(tmp_path: Path) -> None:
    took, ratio = departures(made_up(tmp_path), "| sum | 50 |", 1.0)
    assert took.endswith("made_up prints no number 1 after 'all of it'")
    assert ratio.endswith("made_up prints no number 2 after '| sum'")


@pytest.mark.parametrize(
    "line",
    [
        "5 <!-- bench made_up: number 1 -->",
        "5 <!-- bench made_up: number 0 after 'sum' -->",
        'five <!-- bench made_up: number 1 after "sum" -->',
    ],
)
def test_a_mark_that_cannot_be_read_is_an_error(tmp_path: Path, line: str) -> None:
    with pytest.raises(ValueError, match=r"page\.md:2: write a figure and <!-- bench NAME"):
        made_up(tmp_path, f"# A page\n{line}\n")


def test_marks_of_the_pages_name_what_make_bench_runs() -> None:
    program = (HERE / "benchmarks/__main__.py").read_text(encoding="utf-8")
    figures = list(page_figures(sorted((HERE / "docs").glob("*.md"))))
    assert len(figures) > 2
    assert {one.benchmark for one in figures} <= set(
        re.findall(r'^    "(\w+)[^"]*",$', program, re.M)
    )
