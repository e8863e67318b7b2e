"""What a notebook shows of answers is short, and a table where there are many."""

import sys
from pathlib import Path

import fleet_slip
from tests.support.commands import finish, run_on, start


def test_answers_are_shown_on_a_line_or_two(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    cohort = fleet.cohort()
    selection = cohort.select(models="table1")
    assert repr(selection).startswith("<Selection: ")
    assert "RMSE" in repr(selection)
    model = fleet.model("smoke")
    assert repr(model).startswith("<ModelVersion smoke@1: ")
    for answer in (selection, model, fleet.status()):
        assert len(repr(answer)) < 500
    assert len(repr(selection.models[0].model)) < 200  # its fractions may have 10,000 digits
    assert "Fraction" not in repr(cohort.diagnose(model))


def test_a_notebook_gets_a_table_with_bars(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    selection = fleet.cohort("campaign <> '<script>'").select(models="table1")
    assert selection._repr_html_().count("<tr>") == 6
    page = fleet.model("smoke")._repr_html_()
    assert page.count("<tr>") == len(fleet.model("smoke").manifest.terms) + 2
    assert page.count("<svg ") == page.count("<tr>") - 1
    assert "<script>" not in selection._repr_html_() + page


KERNEL = """
import sys, types
sys.modules["IPython"] = types.ModuleType("IPython")  # what DuckDB takes for a notebook
sys.modules["IPython"].get_ipython = lambda: types.SimpleNamespace(config={"IPKernelApp": {}})
sys.modules["ipywidgets"] = None
from fleet_slip.warehouse.database import open_database
print(open_database().sql("SELECT 42").fetchall())
"""


def test_a_notebook_needs_no_widgets() -> None:
    assert finish(start([sys.executable, "-c", KERNEL]))[0].stdout == "[(42,)]\n"


def test_an_answer_is_the_text_that_its_command_prints(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    answers = {"quality": fleet.quality(), "diagnose smoke": fleet.cohort().diagnose("smoke")}
    for words, answer in answers.items():
        assert str(answer) == run_on(smoke_root, *words.split()).stdout.rstrip()
