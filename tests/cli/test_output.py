"""Output on a terminal, and of queries: a table or a file."""

import contextlib
import csv
import io
import json
from collections.abc import Callable
from pathlib import Path

import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest
from rich.text import Text

from fleet_slip.cli.app import app
from fleet_slip.cli.output import print_parts
from fleet_slip.errors import AlarmError
from fleet_slip.rendering import TextTable
from tests.support.commands import RunCommand, run_on

QUERY = "SELECT drive_id, rows, 52.660000000000004::DOUBLE AS exact FROM drives ORDER BY 1"


def test_a_table_has_numbers_that_people_read_and_json_those_that_are_there(
    run_command: RunCommand, smoke_root: Path
) -> None:
    table = run_command("sql", QUERY, root=smoke_root).stdout
    assert "52.66 " in table
    assert "52.6600" not in table
    document = run_command("sql", f"{QUERY} LIMIT 3", "--json", root=smoke_root).json
    assert [row["exact"] for row in document] == [52.660000000000004] * 3
    odd = run_command("sql", "SELECT 'nan'::DOUBLE a, NULL::DOUBLE b, 1e300 c", root=smoke_root)
    assert {"nan", "NULL", "1e+300"} <= set(odd.stdout.replace("│", " ").split())


def test_a_table_can_be_asked_for_whole(run_command: RunCommand, smoke_root: Path) -> None:
    query = "SELECT i, repeat('x', 300) AS long FROM range(100) r(i)"
    short = run_command("sql", query, root=smoke_root)
    assert "output truncated" in short.stderr
    cut = short.stdout
    output = run_command("sql", query, "--all", root=smoke_root).stdout
    assert "x" * 300 not in cut
    assert output.count("x" * 300) == 100


@pytest.mark.parametrize("suffix", ["parquet", "csv", "json"])
def test_an_answer_becomes_a_file(
    run_command: RunCommand, smoke_root: Path, tmp_path: Path, suffix: str
) -> None:
    file = tmp_path / f"drives.{suffix}"
    done = run_command("sql", f"{QUERY} LIMIT 5", "--output", str(file), root=smoke_root)
    assert done.exit_code == 0, done.stderr
    assert "5 rows" in done.stderr
    match suffix:
        case "parquet":
            rows = pq.read_table(file).to_pylist()
        case "csv":
            rows = pc.read_csv(file).to_pylist()
        case _:
            rows = json.loads(file.read_text("utf-8"))
    assert len(rows) == 5
    assert rows[0]["exact"] == 52.660000000000004


def test_an_unwritable_output_is_reported(
    run_command: RunCommand, smoke_root: Path, tmp_path: Path
) -> None:
    other = run_command("sql", QUERY, "--output", "drives.xlsx", root=smoke_root)
    assert (other.exit_code, ".parquet, .csv or .json" in other.stderr) == (2, True)
    file = tmp_path / "missing" / "drives.csv"
    absent = run_command("sql", QUERY, "--output", str(file), root=smoke_root)
    assert (absent.exit_code, "No such file" in absent.stderr) == (6, True)
    for path, problem in ((file, "no such folder. Create it"), (tmp_path, "a folder, not a file")):
        contract = run_command("contract", "--output", str(path), root=smoke_root)
        assert contract.exit_code == 6 and problem in contract.stderr


def test_statements_on_stdin_are_answered_one_after_the_other(
    run_command: RunCommand, smoke_root: Path
) -> None:
    text = "SELECT 41 + 1 AS a;\n-- and\nSELECT 'é;' AS b;"
    for words in (["sql", "--csv"], ["sql", "-", "--csv"]):
        done = run_command(*words, root=smoke_root, input=text)
        assert done.stdout == '"a"\n42\n"b"\n"é;"\n', done.stderr
    done = run_command("sql", root=smoke_root, input="SELECT 42; DROP VIEW log; SELECT 43")
    assert (done.exit_code, "42" in done.stdout, "43" in done.stdout) == (5, True, False)
    assert "only queries are allowed" in done.stderr
    assert run_command("sql", "SELECT 1; SELECT 2", root=smoke_root).exit_code == 5
    assert run_command("sql", root=smoke_root, input="").exit_code == 5


def cells(text: str) -> list[list[str]]:
    return list(csv.reader(io.StringIO(text)))[1:]


def test_a_text_that_is_a_formula_is_marked_in_csv(
    run_command: RunCommand, smoke_root: Path
) -> None:
    texts = [begin + "cmd|'/C calc'!A0" for begin in "=+-@\t\r\n＝＋－＠"]
    values = ["chr(" + ") || chr(".join(str(ord(c)) for c in text) + ")" for text in texts]
    query = "SELECT " + ", ".join(values) + ", -1.5"
    done = run_command("sql", query, "--csv", root=smoke_root)
    texts = [text.replace("\r", "\n") for text in texts]  # as subprocess reads it
    assert cells(done.stdout) == [[*("'" + text for text in texts), "-1.5"]]
    assert f"{len(texts)} texts that begin like a formula" in done.stderr
    exact = run_command("sql", query, "--csv", "--exact", root=smoke_root)
    assert (cells(exact.stdout), exact.stderr) == ([[*texts, "-1.5"]], "")


Shown = Callable[..., list[str]]

WIDTHS = [80, *(pytest.param(width, marks=pytest.mark.long) for width in (100, 160))]
COMMANDS = [
    "models",
    "show smoke",
    "select",
    "select --order ay,yaw_rate,ax",
    "quality",
    "status",
    "features",
    "features --files",
    "diagnose smoke",
]


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
    print_parts([TextTable("", HEADER, ROWS, text_columns=2)])
    return Text.from_ansi(capsys.readouterr().out).plain


def test_a_table_shrinks_between_words(
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


@pytest.mark.parametrize(
    "command",
    [
        ["sql", "SELECT chr(27) || '[2J' AS name", "--csv"],
        ["sql", "SELECT chr(27) || '[2J' AS name"],
        ["select", "--cohort", "drive_id <> '\x1b[2J'"],
    ],
    ids=["csv", "table", "cohort"],
)
def test_a_terminal_is_sent_no_control_characters(
    smoke_root: Path,
    capsysbinary: pytest.CaptureFixture[bytes],
    monkeypatch: pytest.MonkeyPatch,
    command: list[str],
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    app(["--root", str(smoke_root), *command], standalone_mode=False)
    output = capsysbinary.readouterr().out
    assert b"[2J" in output
    assert b"\x1b[2J" not in output


def test_a_pipe_is_sent_texts_as_they_are(
    smoke_root: Path, capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    query = "SELECT chr(27) || '[2J' AS name"
    app(["--root", str(smoke_root), "sql", query, "--csv"], standalone_mode=False)
    assert b'"\x1b[2J"' in capsysbinary.readouterr().out


@pytest.mark.parametrize("command", ["select", "show smoke"])
def test_first_commands_fit_a_screen_of_80_columns(
    smoke_root: Path, shown: Shown, command: str
) -> None:
    def give() -> None:
        app(["--root", str(smoke_root), *command.split()], standalone_mode=False)

    lines = shown(give, 80)
    assert max(map(len, lines)) <= 80
    assert len(lines) < 50
    full = shown(
        lambda: app(["--root", str(smoke_root), *command.split(), "--all"], standalone_mode=False),
        200,
    )
    assert sum(map(len, full)) > sum(map(len, lines))


def test_the_winner_stands_first(smoke_root: Path, shown: Shown) -> None:
    lines = shown(lambda: app(["--root", str(smoke_root), "select"], standalone_mode=False), 80)
    assert lines[0].startswith(("winner: physical ", "winner: windows "))
    at = next(i for i, line in enumerate(lines) if "(--all)" in line)
    names = [line.split("  ")[0] for line in lines[at + 2 :] if not line.startswith(" ")]
    assert names == [*"12345", lines[0].removeprefix("winner: ").partition(".")[0]]


def test_a_typo_in_a_condition_names_the_nearest_column_that_may_be_used(smoke_root: Path) -> None:
    done = run_on(smoke_root, "select", "--cohort", "speed_facto > 1")
    assert done.exit_code == 5
    assert "Did you mean speed_factor? Columns: adhesion, campaign, day" in done.stderr
    assert "ay_mps2" not in done.stderr, "a cohort is of drives"
