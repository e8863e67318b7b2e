"""Exports of models with names at the ends of what names may be, and of drives without rows."""

import subprocess
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

import cantools
import numpy as np
import onnxruntime
import pandas as pd
import polars as pl
import pytest
from cantools.database.can.database import Database

from fleet_slip.errors import InputError
from fleet_slip.export import files as export
from fleet_slip.export.files import export_files
from fleet_slip.export.mlflow import LoggedVersion
from fleet_slip.export.templating import distinct
from fleet_slip.models.registry import ModelVersion
from tests.export.compiled import compile_c, needs_cc
from tests.export.engines import by_duckdb, by_sqlite
from tests.export.models import LONGEST, MODELS, TEXTS, hostile_version, model_of
from tests.support.catalog import CATALOG, SIGNALS

EMPTY = model_of(MODELS["every_kind"], name="empty")


VERSION = hostile_version()


def exported(to: str) -> dict[str, bytes]:
    return export_files(VERSION, None, to)


def test_names_are_different_however_they_are_made() -> None:
    assert distinct(["a", "a", "a_2", "a"]) == ("a", "a_2", "a_2_2", "a_3")
    long = distinct(["x" * 40, "x" * 40, "x" * 32, "x" * 30 + "_2"], 32)
    assert len({*long}) == 4
    assert {len(name) for name in long} == {32}


@needs_cc
def test_c_with_the_longest_names_passes_its_self_test(tmp_path: Path) -> None:
    files = exported("c")
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    (stem,) = {name.removesuffix("_test.c") for name in files if name.endswith("_test.c")}
    assert len(stem) == 24
    program = compile_c(tmp_path, [f"{stem}.c", f"{stem}_test.c"])
    done = subprocess.run([program], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (0, f"{LONGEST}@1: 0 of 900 angles are wrong\n")


def test_fmus_have_a_parameter_for_each_fact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the binary: what is compiled is that of other models, in test_fmu."""
    monkeypatch.setattr(export, "_compile", lambda sources: repr([*sources]).encode())
    for content in exported("fmu").values():
        if not content.startswith(b"PK"):
            continue
        with zipfile.ZipFile(BytesIO(content)) as archive:
            root = ElementTree.fromstring(archive.read("modelDescription.xml"))  # noqa: S314 - our own
        named = [
            element.attrib
            for element in root.iter()
            if {"name", "valueReference"} <= {*element.attrib}
        ]
        assert len({element["name"] for element in named}) == len(named)
        assert len({element["valueReference"] for element in named}) == len(named)
        parameters = [element for element in named if element.get("causality") == "parameter"]
        assert len(parameters) == len(TEXTS)


def test_a_dbc_file_is_read_and_names_no_signal_twice() -> None:
    text = exported("dbc")[f"sideslip_{LONGEST}.dbc"].decode()
    bus = cantools.database.load_string(text, "dbc", strict=True)
    assert isinstance(bus, Database)
    names = [signal.name for message in bus.messages for signal in message.signals]
    assert len({*names}) == len(names)
    assert all(len(name) <= 32 for name in names)


def test_onnx_takes_no_car_at_all() -> None:
    model = exported("onnx")[f"sideslip_{LONGEST}_float32.onnx"]
    session = onnxruntime.InferenceSession(model)
    width = {node.name: node.shape[1] for node in session.get_inputs()}
    kinds = {"signals": np.float32}
    feeds = {node: np.empty((0, n), kinds.get(node, np.int64)) for node, n in width.items()}
    assert session.run(["angle"], feeds)[0].shape == (0, 1)


def empty_log() -> pl.DataFrame:
    columns: Mapping[str, type[pl.DataType]] = dict.fromkeys(EMPTY.columns(SIGNALS), pl.Float64)
    facts = {"mass_kg": pl.Float64, "vehicle_model": pl.String}
    numbers = dict.fromkeys(("yaw_rate_offset", "speed_ratio", "understeer"), pl.Float64)
    return pl.DataFrame(
        schema={"drive_id": pl.String, "tick": pl.Int64, **columns, **facts, **numbers}
    )


def test_sql_of_a_log_without_rows_has_none() -> None:
    statement = export_files(ModelVersion(1, EMPTY, "0" * 64, CATALOG), None, "sql")[
        "sideslip_empty.sql"
    ]
    assert by_duckdb(statement.decode(), empty_log()) == {}
    assert by_sqlite(statement.decode(), empty_log()) == {}


def test_a_model_of_mlflow_takes_empty_frames_and_names_missing_columns() -> None:
    loaded = LoggedVersion(SIGNALS, EMPTY)
    frame: pd.DataFrame = empty_log().to_pandas()
    assert loaded.predict(frame).shape == (0, 1)
    with pytest.raises(InputError, match="the frame lacks ay_mps2"):
        loaded.predict(frame.drop(columns="ay_mps2"))
    with pytest.raises(InputError, match="needs properties of the car: mass_kg"):
        loaded.predict(frame.drop(columns="mass_kg"))
