"""The data contract: every column of the views, with units, ranges and keys."""

from pathlib import Path
from typing import Any

import pytest
import yaml

import fleet_slip
from tests.support.catalog import CATALOG
from tests.support.commands import RunCommand, run


@pytest.fixture(scope="module")
def contract(smoke_root: Path) -> Any:
    """The document as YAML reads it."""
    from fleet_slip.operations.data_contract import data_contract  # noqa: PLC0415 - takes a while

    return yaml.safe_load(data_contract(fleet_slip.open(smoke_root).warehouse))


def test_the_contract_has_the_columns_of_the_views(smoke_root: Path, contract: Any) -> None:
    assert contract["apiVersion"] == "v3.1.0"
    views = {view["name"]: view["properties"] for view in contract["schema"]}
    assert list(views) == ["log", "drives", "grams", "models"]
    with fleet_slip.connect(smoke_root) as database:
        for view, properties in views.items():
            columns = database.execute(f"DESCRIBE {view}").fetchall()
            expected = [
                (name, kind.replace("TIMESTAMP WITH TIME ZONE", "TIMESTAMPTZ"))
                for name, kind, *_ in columns
            ]
            assert [(p["name"], p["physicalType"]) for p in properties] == expected
    assert not [p["name"] for view in views.values() for p in view if not p["description"]]


def test_signals_have_the_units_and_ranges_of_the_catalog(contract: Any) -> None:
    log = {column["name"]: column for column in contract["schema"][0]["properties"]}
    for signal in CATALOG.signals.signals.values():
        column = log[signal.column]
        assert column["customProperties"] == [{"property": "unit", "value": signal.unit}]
        limits = {"minimum": float(signal.min), "maximum": float(signal.max)}
        assert column["logicalTypeOptions"] == limits
    keys = [name for name, column in log.items() if column.get("primaryKey")]
    assert keys == ["drive_id", "tick"]


@pytest.mark.long
@pytest.mark.tools("datacontract")
def test_the_contract_is_valid_and_the_rows_satisfy_it(
    run_command: RunCommand, smoke_root: Path, tmp_path: Path
) -> None:
    """The views are written to Parquet, which the tool of the standard can read."""
    file = tmp_path / "fleet.odcs.yaml"
    done = run_command("contract", "--output", str(file), root=smoke_root)
    assert done.exit_code == 0, done.stderr
    linted = run(["datacontract", "lint", str(file)])
    assert linted.exit_code == 0, linted.stdout
    assert "warning" not in linted.stdout
    with fleet_slip.connect(smoke_root) as database:
        for view in ("log", "drives", "models"):
            database.sql(f"FROM {view}").pl().write_parquet(tmp_path / f"{view}.parquet")
    contract = yaml.safe_load(file.read_text())
    server = {
        "server": "files",
        "type": "local",
        "format": "parquet",
        "path": f"{tmp_path}/{{model}}.parquet",
    }
    for view in contract["schema"]:
        for column in view["properties"]:
            del column["physicalType"]  # the tool does not translate types of DuckDB
    tables = [view for view in contract["schema"] if view["name"] != "grams"]
    file.write_text(yaml.safe_dump({**contract, "servers": [server], "schema": tables}))
    tested = run(["datacontract", "test", str(file)])
    assert tested.exit_code == 0, tested.stdout
