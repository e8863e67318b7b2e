"""Where the answer to a query goes: a table for people, whole or not, or a file."""

import csv
import io
import json
from pathlib import Path

import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest

from tests.support.commands import RunCommand

QUERY = "SELECT drive_id, rows, 52.660000000000004::DOUBLE AS exact FROM drives ORDER BY 1"


def test_a_table_has_numbers_that_people_read_and_json_those_that_are_there(
    run_command: RunCommand, smoke_root: Path
) -> None:
    table = run_command("sql", QUERY, root=smoke_root).stdout
    assert "52.66 " in table
    assert "52.6600" not in table
    told = run_command("sql", f"{QUERY} LIMIT 3", "--json", root=smoke_root).json
    assert [row["exact"] for row in told] == [52.660000000000004] * 3
    odd = run_command("sql", "SELECT 'nan'::DOUBLE a, NULL::DOUBLE b, 1e300 c", root=smoke_root)
    assert {"nan", "NULL", "1e+300"} <= set(odd.stdout.replace("│", " ").split())


def test_a_table_can_be_asked_for_whole(run_command: RunCommand, smoke_root: Path) -> None:
    query = "SELECT i, repeat('x', 300) AS long FROM range(100) r(i)"
    short = run_command("sql", query, root=smoke_root)
    assert "output truncated" in short.stderr
    cut = short.stdout
    whole = run_command("sql", query, "--all", root=smoke_root).stdout
    assert "x" * 300 not in cut
    assert whole.count("x" * 300) == 100


def test_what_fits_is_shown_whole_and_nothing_is_said(
    run_command: RunCommand, smoke_root: Path
) -> None:
    told = run_command("sql", "SELECT drive_id, lost_control_s FROM drives", root=smoke_root)
    assert "NULL" in told.stdout
    assert told.stderr == ""


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


def test_where_nothing_can_be_written_is_said(
    run_command: RunCommand, smoke_root: Path, tmp_path: Path
) -> None:
    other = run_command("sql", QUERY, "--output", "drives.xlsx", root=smoke_root)
    assert (other.exit_code, ".parquet, .csv or .json" in other.stderr) == (2, True)
    file = tmp_path / "missing" / "drives.csv"
    absent = run_command("sql", QUERY, "--output", str(file), root=smoke_root)
    assert (absent.exit_code, "No such file" in absent.stderr) == (6, True)


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


def test_other_texts_are_printed_as_they_are(run_command: RunCommand, smoke_root: Path) -> None:
    query = "SELECT unnest(['a=b', '', NULL, '2024-05-01', ' =x'::VARCHAR]) AS a, -2 AS b"
    done = run_command("sql", query, "--csv", root=smoke_root)
    assert [row[0] for row in cells(done.stdout)] == ["a=b", "", "", "2024-05-01", " =x"]
    assert done.stderr == ""
