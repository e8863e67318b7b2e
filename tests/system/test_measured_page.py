"""The page of measurements is written from its records, and marks figures older than the code."""

import json
from pathlib import Path

from tests.support.measured_page import PAGE, STALE, digest_code, load_sections, write_page


def without_marks(text: str) -> str:
    return text.replace(f", **{STALE}**", "")


def test_the_page_is_what_its_records_give() -> None:
    """The marks depend on the code; `make docs` writes them."""
    assert without_marks(PAGE.read_text("utf-8")) == without_marks(write_page(load_sections()))


def test_every_figure_has_a_date_a_machine_and_existing_code() -> None:
    for file, content in load_sections().items():
        for figure in content["figures"]:
            keys = {"figure", "command", "commit", "date", "machine", "code", "code_sha256"}
            assert keys <= figure.keys(), (file, figure)
            assert figure["date"] and figure["machine"]
            assert all((PAGE.parents[1] / path).exists() for path in figure["code"]), figure
            assert ("value" in figure) != ("rows" in figure)
            assert all(len(row) == len(figure["columns"]) for row in figure.get("rows", []))


def test_a_figure_is_marked_once_its_code_changes(tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    module = tmp_path / "package/module.py"
    module.write_text("x = 1\n")
    figure = {
        "figure": "rate",
        "value": "4 rows/s",
        "command": "make bench",
        "commit": "abc",
        "date": "2026-11-28",
        "machine": "laptop",
        "code": ["package"],
        "code_sha256": digest_code(["package"], tmp_path),
    }
    file = tmp_path / "rates.json"
    file.write_text(json.dumps({"position": 1, "title": "Rates", "figures": [figure]}))
    fresh = write_page(load_sections(tmp_path), tmp_path)
    assert "| rate | 4 rows/s | `make bench` | 2026-11-28 at abc |" in fresh
    module.write_text('"""Text."""\n\n# a comment\nx = 1\n')
    assert write_page(load_sections(tmp_path), tmp_path) == fresh
    module.write_text("x = 2\n")
    assert "2026-11-28 at abc, **older than the code** |" in write_page(
        load_sections(tmp_path), tmp_path
    )
