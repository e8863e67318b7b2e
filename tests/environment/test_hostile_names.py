"""Names that a spreadsheet would execute."""

import csv
import io
from pathlib import Path

import pytest

from tests.support.commands import RunCommand


@pytest.fixture(autouse=True)
def data_root(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()


def cells(text: str) -> list[list[str]]:
    return list(csv.reader(io.StringIO(text)))[1:]


def test_a_text_that_is_a_formula_is_marked_in_csv(run_command: RunCommand) -> None:
    texts = [begin + "cmd|'/C calc'!A0" for begin in "=+-@\t\r\n＝＋－＠"]
    values = ["chr(" + ") || chr(".join(str(ord(c)) for c in text) + ")" for text in texts]
    query = "SELECT " + ", ".join(values) + ", -1.5"
    done = run_command("sql", query, "--csv")
    texts = [text.replace("\r", "\n") for text in texts]  # as subprocess reads it
    assert cells(done.stdout) == [[*("'" + text for text in texts), "-1.5"]]
    assert f"{len(texts)} texts that begin like a formula" in done.stderr
    exact = run_command("sql", query, "--csv", "--exact")
    assert (cells(exact.stdout), exact.stderr) == ([[*texts, "-1.5"]], "")


def test_other_texts_are_printed_as_they_are(run_command: RunCommand) -> None:
    query = "SELECT unnest(['a=b', '', NULL, '2024-05-01', ' =x'::VARCHAR]) AS a, -2 AS b"
    done = run_command("sql", query, "--csv")
    assert [row[0] for row in cells(done.stdout)] == ["a=b", "", "", "2024-05-01", " =x"]
    assert done.stderr == ""
