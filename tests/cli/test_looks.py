"""What a terminal of 80, 100 and 160 columns shows: no word is broken, and nothing is cut off."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rich.text import Text

from fleet_slip.cli.app import app
from fleet_slip.cli.output import print_parts
from fleet_slip.errors import AlarmError
from fleet_slip.evaluation.evaluate import Evaluation
from fleet_slip.models import select
from fleet_slip.models.request import SelectionRequest
from fleet_slip.rendering import TextTable
from fleet_slip.warehouse.tables import Warehouse

Shown = Callable[..., list[str]]

WIDTHS = [80, *(pytest.param(width, marks=pytest.mark.long) for width in (100, 160))]
COMMANDS = [
    "models",
    "show smoke",
    "select",
    "select --all-subsets",
    "select --nested ay,yaw_rate,ax",
    "quality",
    "status",
    "features",
    "features --files",
    "diagnose smoke",
]


@pytest.fixture(scope="module", autouse=True)
def chosen_once() -> Iterator[None]:
    """Let what is asked for again be shown again: to choose takes longer than to show."""
    answer, answers = select.answer_request, dict[str, select.Selection]()

    def once(warehouse: Warehouse, request: SelectionRequest, condition: str) -> select.Selection:
        asked = f"{request} {condition}"
        if asked not in answers:
            answers[asked] = answer(warehouse, request, condition)
        return answers[asked]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(select, "answer_request", once)
        yield


@pytest.fixture(params=WIDTHS)
def shown(
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Shown:
    """Return the lines that a terminal shows of what a function prints."""

    def look(show: Callable[[], object], columns: int = request.param) -> list[str]:
        monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
        monkeypatch.setenv("COLUMNS", str(columns))
        show()
        lines = Text.from_ansi(capsys.readouterr().out).plain.splitlines()
        assert lines
        assert [line for line in lines if len(line) > columns] == []
        return lines

    return look


@pytest.mark.parametrize("command", COMMANDS)
def test_every_word_is_whole(smoke_root: Path, shown: Shown, command: str) -> None:
    def give() -> None:
        words = ["--root", str(smoke_root), *command.split()]
        with contextlib.suppress(AlarmError):
            app(words, standalone_mode=False)

    words = {word for line in shown(give) for word in line.split()}
    assert words <= {word for line in shown(give, 2000) for word in line.split()}


HEADER = "model|signals|drives|RMSE deg"
ROWS = [["2", "ax ay yaw_rate steering_wheel", "96", "0.0735"], ["ours", "", "", "0.0302"]]


def table(width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", str(width))
    print_parts([TextTable("", HEADER, ROWS, left=2)])
    return Text.from_ansi(capsys.readouterr().out).plain


def test_a_table_shrinks_between_words_and_then_becomes_paragraphs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        table(80, monkeypatch, capsys)
        == """\
model  signals                        drives  RMSE deg
2      ax ay yaw_rate steering_wheel      96    0.0735
ours                                            0.0302
"""
    )
    assert (
        table(40, monkeypatch, capsys)
        == """\
model  signals          drives  RMSE deg
2      ax ay yaw_rate       96    0.0735
       steering_wheel
ours                              0.0302
"""
    )
    assert table(34, monkeypatch, capsys).splitlines()[1] == "model signals        drives    deg"
    assert table(30, monkeypatch, capsys).splitlines()[:6] == [
        "model     2",
        "signals   ax ay yaw_rate",
        "          steering_wheel",
        "drives    96",
        "RMSE deg  0.0735",
        "",
    ]


def test_prose_breaks_between_words_and_commands_do_not(shown: Shown) -> None:
    lines = shown(lambda: print_parts(["a model of the fleet " * 20]))
    assert " ".join(lines).split() == ("a model of the fleet " * 20).split()


def test_an_evaluation_is_a_screen(shown: Shown) -> None:
    standing = {"scenario": "nominal", "winner": "ekf", "winner_rmse_deg": 0.1, "rmse_deg": 0.2}
    ranking = {
        "estimator": "ours@1",
        "least_coverage": 0.99,
        "close_ratio": 1.25,
        "drives": 1,
        "won": 0,
        "close": 0,
        "standings": [{**standing, "ratio": 2.0, "same_as": None}],
    }
    result = {"rmse_deg": 0.2, "coverage": 0.35}
    scenario = {
        "name": "nominal",
        "truth": {"sideslip_std_deg": 0.7},
        "results": {"ours@1": result},
    }
    content = {"estimators": {"ours@1": {}}, "ranking": ranking, "scenarios": [scenario]}
    evaluation = Evaluation(content)
    text = " ".join(" ".join(shown(lambda: print_parts(evaluation.parts()))).split())
    assert "nominal ekf 0.100 0.200 2.00" in text
    assert "Every drive, and all estimators: --all" in text
    whole = " ".join(" ".join(shown(lambda: print_parts(evaluation.parts(True)))).split())
    assert "nominal 0.70 0.200 (35%)" in whole


@pytest.mark.parametrize("command", ["select", "show smoke"])
def test_what_a_newcomer_asks_first_is_a_screen_of_80_columns(
    smoke_root: Path, shown: Shown, command: str
) -> None:
    def give() -> None:
        app(["--root", str(smoke_root), *command.split()], standalone_mode=False)

    lines = shown(give, 80)
    assert max(map(len, lines)) <= 80
    assert len(lines) < 50
    whole = shown(
        lambda: app(["--root", str(smoke_root), *command.split(), "--all"], standalone_mode=False),
        200,
    )
    assert sum(map(len, whole)) > sum(map(len, lines))


def test_the_winner_stands_first(smoke_root: Path, shown: Shown) -> None:
    lines = shown(lambda: app(["--root", str(smoke_root), "select"], standalone_mode=False), 80)
    assert lines[0].startswith(("winner: physical ", "winner: windows "))
    at = next(i for i, line in enumerate(lines) if "(--all)" in line)
    assert len(lines) - at - 2 == 10
