"""Names that a spreadsheet would execute, and names that only look the same."""

import csv
import io
import unicodedata
from pathlib import Path

import pytest

from fleet_slip.ingest.job import ingest_files
from fleet_slip.ingest.log_rows import find_look_alikes
from fleet_slip.warehouse.tables import Warehouse
from tests.support.commands import RunCommand
from tests.support.measured import a_mapping, csv_text, good_columns

NFC, NFD = (unicodedata.normalize(form, "Zoë") for form in ("NFC", "NFD"))


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


def test_names_in_another_form_are_found_and_others_are_not() -> None:
    assert NFC != NFD
    assert find_look_alikes([NFC, NFD, NFC, "Zoe", "zoë", "other"]) == ((NFD, NFC),)


def test_cars_and_drives_of_one_file_that_look_the_same_are_pointed_out(
    tmp_path: Path, warehouse: Warehouse
) -> None:
    columns = good_columns() | {"car": [NFC] * 10 + [NFD] * 10}
    for place in ("vehicle_id", "column"):
        columns["ax"] = [f"{len(place)}"] * 20
        drive = {place: {"column": "car"}} if place == "vehicle_id" else {place: "car"}
        (tmp_path / "log.csv").write_text(csv_text(columns))
        (report,) = ingest_files(warehouse, [tmp_path / "log.csv"], a_mapping(drive=drive))
        assert (report.new, report.look_alikes) == (True, ((NFD, NFC),)), place


def test_a_car_that_looks_like_one_of_the_logs_is_pointed_out(
    tmp_path: Path, warehouse: Warehouse
) -> None:
    found = []
    for number, name in enumerate((NFC, "other", NFD)):
        columns = good_columns() | {"ax": [f"{number}"] * 20}
        (tmp_path / "log.csv").write_text(csv_text(columns))
        mapping = a_mapping(drive={"vehicle_id": name})
        found += [r.look_alikes for r in ingest_files(warehouse, [tmp_path / "log.csv"], mapping)]
    assert found == [(), (), ((NFD, NFC),)]
