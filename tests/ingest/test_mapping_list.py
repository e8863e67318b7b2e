"""Several mappings for one landing folder: each file goes through its own."""

from pathlib import Path

import pytest

from fleet_slip.errors import ConfigError
from fleet_slip.ingest.mapping import as_list
from tests.support.commands import Finished, run_on
from tests.support.measured import csv_text, good_columns

MAPPING = """name = "{name}"
[time]
column = "{time}"
unit = "s"
[drive]
day = 2024-05-31
vehicle_id = "{name}"
vehicle_model = "sedan"
[signals]
ax = {{ column = "ax", unit = "m/s^2" }}
"""

LIST = """
[[mappings]]
files = "leaf"
mapping = "leaf.toml"
[[mappings]]
files = "car-*.csv"
mapping = "car.toml"
[[mappings]]
files = "notes/*"
"""


def write_log(file: Path, rows: int, time: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    columns = good_columns(rows)
    file.write_text(csv_text({time: columns["t"], "ax": columns["ax"]}))


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a landing folder of two kinds of logs, and a list of their mappings."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    for name, time in (("car", "t"), ("leaf", "clock")):
        (tmp_path / f"{name}.toml").write_text(MAPPING.format(name=name, time=time))
    (tmp_path / "mixed.toml").write_text(LIST)
    landing = tmp_path / "landing"
    write_log(landing / "leaf" / "monday" / "1.csv", 21, "clock")
    write_log(landing / "car-1.csv", 22, "t")
    write_log(landing / "tuesday" / "car-2.csv", 23, "t")
    write_log(landing / "notes" / "1.csv", 24, "seconds")
    return tmp_path


def ingest(place: Path, *words: str) -> Finished:
    mapping = str(place / "mixed.toml")
    return run_on(place / "data", "ingest", str(place / "landing"), "--mapping", mapping, *words)


def landed(place: Path) -> dict[str, int]:
    """Rows by car."""
    query = "SELECT vehicle_id, count(*) AS n FROM log GROUP BY 1 ORDER BY 1"
    done = run_on(place / "data", "sql", query, "--json")
    return {row["vehicle_id"]: row["n"] for row in done.json}


def test_each_file_lands_once_through_its_own_mapping(place: Path) -> None:
    tried = ingest(place, "--dry-run", "--json")
    assert tried.exit_code == 0, tried.stderr
    assert sorted(one["ticks"] for one in tried.json) == [21, 22, 23]
    done = ingest(place)
    assert (done.exit_code, done.stderr) == (0, "3 new files: 66 rows in 3 drives\n")
    assert landed(place) == {"car": 45, "leaf": 21}
    assert ingest(place).stderr == "nothing new\n"


def test_what_none_or_two_take_is_said_once_and_holds_up_nothing(place: Path) -> None:
    write_log(place / "landing" / "stray.csv", 25, "t")
    write_log(place / "landing" / "leaf" / "car-3.csv", 26, "t")
    (place / "landing" / "leaf" / "torn.csv").write_text("torn")
    done = ingest(place)
    assert landed(place) == {"car": 45, "leaf": 21}
    assert done.exit_code == 4
    assert done.stderr.count("stray.csv") == done.stderr.count("car-3.csv") == 1
    (place / "landing" / "leaf" / "torn.csv").unlink()
    again = ingest(place)
    assert again.exit_code == 10
    assert again.stderr.endswith(
        "mixed.toml: 1 log (stray.csv) of no mapping and 1 log (leaf/car-3.csv) of several "
        "mappings left out. Give each file one mapping in it, or none, and it is left alone.\n"
    )


def test_patterns_are_seen_from_the_folder_that_is_given(place: Path) -> None:
    mapping = str(place / "mixed.toml")
    pattern = str(place / "landing" / "l*" / "**" / "*.csv")
    done = run_on(place / "data", "ingest", pattern, "--mapping", mapping)
    assert (done.exit_code, landed(place)) == (0, {"leaf": 21}), done.stderr
    file = str(place / "landing" / "car-1.csv")
    done = run_on(place / "data", "ingest", file, "--mapping", mapping)
    assert (done.exit_code, landed(place)) == (0, {"car": 22, "leaf": 21}), done.stderr


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("mappings = []", "mappings: "),
        ('[[mappings]]\nfile = "leaf"', "mappings.0.files: is missing"),
        ('[[mappings]]\nfiles = "leaf"\nmapping = "gone.toml"', "gone.toml: no such file"),
    ],
)
def test_a_list_that_is_none_is_refused(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "list.toml").write_text(text)
    with pytest.raises(ConfigError, match=told):
        as_list(str(tmp_path / "list.toml"))
