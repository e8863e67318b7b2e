"""A table of the cars beside a mapping."""

from pathlib import Path

import pytest

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import ConfigError, InputError
from fleet_slip.ingest.mapping import Mapping, load_mapping
from fleet_slip.resources import config_file
from tests.support.measured import read_columns

MAPPING = """
name = "fleet"
vehicles = "cars.csv"
time = { column = "t", unit = "s" }
drive = { day = 2024-05-31, vehicle_id = { column = "car" } }
signals.ax = { column = "ax", unit = "m/s^2" }
"""
CARS = "vehicle_id,vehicle_model,mass_kg,tyres\nA7,suv,1900,winter 225/50\nB2,sedan,,\n"
COLUMNS = {"t": [0, 0.01, 0, 0.01], "car": ["A7", "A7", "B2", "B2"], "ax": [1, 2, 3, 4]}


def load(folder: Path, cars: str = CARS, mapping: str = MAPPING) -> Mapping:
    (folder / "cars.csv").write_text(cars, encoding="utf-8")
    (folder / "fleet.toml").write_text(mapping, encoding="utf-8")
    return load_mapping(str(folder / "fleet.toml"))


def test_drives_get_what_is_known_of_their_car(tmp_path: Path) -> None:
    drives = read_columns(tmp_path, COLUMNS, load(tmp_path)).drives.to_pylist()
    known = {(d["vehicle_id"], d["vehicle_model"], d["mass_kg"], d["tyres"]) for d in drives}
    assert known == {("A7", "suv", 1900.0, "winter 225/50"), ("B2", "sedan", None, None)}


def test_what_the_mapping_says_comes_before_the_table(tmp_path: Path) -> None:
    said = MAPPING.replace('"car" } }', '"car" }, mass_kg = 1500 }')
    drives = read_columns(tmp_path, COLUMNS, load(tmp_path, mapping=said)).drives.to_pylist()
    assert {d["mass_kg"] for d in drives} == {1500.0}


def test_other_facts_are_other_data(tmp_path: Path) -> None:
    before = read_columns(tmp_path, COLUMNS, load(tmp_path)).digest
    after = read_columns(tmp_path, COLUMNS, load(tmp_path, CARS.replace("1900", "1901"))).digest
    assert before != after


def test_a_car_that_is_not_in_the_table_is_an_error(tmp_path: Path) -> None:
    mapping = load(tmp_path, CARS.replace("B2", "C3"))
    with pytest.raises(InputError, match=r"log\.csv: the car 'B2' is not in the table"):
        read_columns(tmp_path, COLUMNS, mapping)


def test_a_car_whose_model_nobody_says_is_an_error(tmp_path: Path) -> None:
    mapping = load(tmp_path, CARS.replace("suv", ""))
    with pytest.raises(InputError, match="nobody says the vehicle_model of the car 'A7'"):
        read_columns(tmp_path, COLUMNS, mapping)


@pytest.mark.parametrize(
    ("cars", "message"),
    [
        ("vehicle_id,mass_kg\nA7,heavy\n", "line 2: mass_kg: must be a number"),
        ("vehicle_id,mass_kg\nA7,-3\n", "line 2: mass_kg: must be greater than 0"),
        ("vehicle_id,colour\nA7,red\n", "line 2: colour: unknown key"),
        ("car,mass_kg\nA7,1\n", "vehicle_id is missing"),
        ("vehicle_id\nA7\nA7\n", "the car 'A7' stands in it twice"),
        ("vehicle_id\n", "it has no row"),
        ("vehicle_id\nA7,1,2\n", "line 2"),
    ],
)
def test_mistakes_in_the_table_are_named_by_file_and_line(
    tmp_path: Path, cars: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load(tmp_path, cars)
    assert "cars.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.csv: no such file"):
        load(tmp_path, mapping=MAPPING.replace("cars.csv", "none.csv"))


def test_without_a_table_the_model_is_needed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"drive\.vehicle_model is needed"):
        load(tmp_path, mapping=MAPPING.replace('vehicles = "cars.csv"', ""))


def test_tyres_need_a_column_of_the_catalogue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = config_file("signals.toml").read_text(encoding="utf-8")
    start = shipped.index("[drive.tyres]")
    own = shipped[:start] + shipped[shipped.index("[drive.adhesion]") :]
    (tmp_path / "signals.toml").write_text(own, encoding="utf-8")
    monkeypatch.setenv("FLEET_SLIP_SIGNALS", str(tmp_path / "signals.toml"))
    catalogue.cache_clear()
    try:
        with pytest.raises(ConfigError, match="line 2: tyres: the catalogue has no such drive"):
            load(tmp_path)
        said = MAPPING.replace('"car" } }', '"car" }, tyres = "winter" }')
        with pytest.raises(ConfigError, match=r"drive\.tyres: the catalogue has no such drive"):
            load(tmp_path, CARS.replace("winter 225/50", ""), said)
        plain = load(tmp_path, "vehicle_id,vehicle_model\nA7,suv\nB2,sedan\n")
        assert len(read_columns(tmp_path, COLUMNS, plain).drives)
    finally:
        catalogue.cache_clear()


@pytest.mark.parametrize("fact", ["tyres", "receiver"])
def test_a_fact_of_a_column_is_known_of_each_drive(tmp_path: Path, fact: str) -> None:
    said = MAPPING.replace('"car" } }', f'"car" }}, {fact} = {{ column = "shoes" }} }}')
    columns = {**COLUMNS, "shoes": ["slick", "slick", "wet", "wet"]}
    drives = read_columns(tmp_path, columns, load(tmp_path, mapping=said)).drives.to_pylist()
    assert {(d["vehicle_id"], d[fact]) for d in drives} == {("A7", "slick"), ("B2", "wet")}
