"""Conversions that files state: applied as they say, or refused; never run, and never left out."""

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import mcap_ros2.writer
import nptdms
import numpy as np
import pytest
from asammdf import MDF, Signal
from asammdf.blocks import conversion_utils, v4_blocks
from mcap.writer import CompressionType

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.confined_reader import open_here
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.source import Budget
from tests.support.commands import within

RAW = np.arange(-100, 100, dtype="i2")
TIME_S = np.arange(RAW.size) / 100
X = RAW.astype(float)
EVIL = "__import__('os').system('id > pwned') or X1*0.05"


def write_mdf(
    folder: Path, conversion: Any, raw: Any = RAW, version: str = "4.10", times: Any = None
) -> Path:
    """A file of a channel with a conversion, and of one without."""
    with MDF(version=version) as mdf:
        mdf.append([Signal(raw, TIME_S[: len(raw)], name="beta")])
        mdf.append([Signal(raw, TIME_S[: len(raw)], name="ax", conversion=conversion)])
        if version < "4":  # where asammdf writes another formula than it is given
            conversion_block: Any = mdf.groups[1].channels[1].conversion
            conversion_block.formula = conversion["formula"]
        if times is not None:
            mdf.groups[1].channels[0].conversion = conversion_utils.from_dict(times)
        return Path(mdf.save(folder / "log.mf4", overwrite=True))


def read(file: Path, name: str, format_name: str = "mdf") -> Any:
    with within(), open_here(format_name, Budget.for_file(file), FileFormats()) as source:
        return np.concatenate([rows[name].to_numpy() for rows in source.batches([name])])


def refusal(file: Path, name: str, format_name: str = "mdf") -> str:
    with pytest.raises((InputError, ValueError)) as caught:
        read(file, name, format_name)
    return str(caught.value)


@pytest.mark.parametrize("version", ["3.30", "4.10"])
@pytest.mark.parametrize("nested", [False, True])
def test_no_formula_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, nested: bool
) -> None:
    assert find_spec("sympy"), "which asammdf would have run it by"
    monkeypatch.chdir(tmp_path)
    conversion: Any = {"formula": EVIL}
    if nested and version >= "4":
        inner = conversion_utils.from_dict(conversion)
        conversion = {"val_0": 99, "text_0": "SNA", "default_addr": inner}
    file = write_mdf(tmp_path, conversion, version=version)
    assert "'ax': its conversion is a formula" in refusal(file, "ax")
    assert not (tmp_path / "pwned").exists()


def test_times_are_not_computed_by_a_formula(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = write_mdf(tmp_path, None, times={"formula": EVIL})
    assert "times with a formula or a table" in refusal(file, "ax")
    assert not (tmp_path / "pwned").exists()


# Tables


def test_ranges_become_their_numbers(tmp_path: Path) -> None:
    """asammdf gives the default for integers within a range."""
    bounds = {"lower_0": -50, "upper_0": -1, "phys_0": 1, "lower_1": 0, "upper_1": 9, "phys_1": 2}
    file = write_mdf(tmp_path, ranges(bounds))
    expected = np.select([(RAW >= -50) & (RAW < 0), (RAW >= 0) & (RAW <= 9)], [1.0, 2.0], 3.0)
    np.testing.assert_array_equal(read(file, "ax"), expected)


def ranges(bounds: dict[str, Any]) -> Any:
    """asammdf makes none from a dictionary."""
    return v4_blocks.ChannelConversion(conversion_type=6, val_param_nr=7, default=3.0, **bounds)


@pytest.mark.parametrize("rows", [200, 90])
@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_named_ranges_are_null_and_the_rest_is_scaled(
    tmp_path: Path, rows: int, scale: float
) -> None:
    """asammdf rounds the bounds down, if there are many rows."""
    raw = RAW[-rows:] if scale == 1 else X[-rows:] * scale
    bounds = {"lower_0": 90.5 * scale, "upper_0": 95.5 * scale, "text_0": b"error"}
    inner = conversion_utils.from_dict({"a": 2.0, "b": 1.0})
    file = write_mdf(tmp_path, {**bounds, "default_addr": inner}, raw)
    named = (raw >= 90.5 * scale) & (raw < 95.5 * scale)
    assert named.sum() == 5
    np.testing.assert_allclose(read(file, "ax"), np.where(named, np.nan, raw * 2 + 1.0))


@pytest.mark.parametrize("rows", [200, 90])
def test_named_values_are_null_and_the_rest_is_physical(tmp_path: Path, rows: int) -> None:
    raw = X[-rows:] / 4
    inner = conversion_utils.from_dict({"a": 2.0, "b": 1.0})
    conversion = {"val_0": 10.5, "text_0": b"SNA", "default_addr": inner}
    file = write_mdf(tmp_path, conversion, raw)
    np.testing.assert_array_equal(read(file, "ax"), np.where(raw == 10.5, np.nan, 2 * raw + 1))


def test_names_alone_stay_names(tmp_path: Path) -> None:
    conversion = {"val_0": 0, "text_0": b"off", "val_1": 1, "text_1": b"on", "default_addr": b"?"}
    values = read(write_mdf(tmp_path, conversion), "ax")
    assert values[99:102].tolist() == ["?", "off", "on"]


def test_a_table_that_is_not_in_order_is_refused(tmp_path: Path) -> None:
    table = {"raw_0": 5, "phys_0": 1, "raw_1": 0, "phys_1": 2, "interpolation": True}
    assert "not sorted" in refusal(write_mdf(tmp_path, table), "ax")


def test_an_unknown_conversion_is_refused(tmp_path: Path) -> None:
    file = write_mdf(tmp_path, {"a": 0.05, "b": 0.0})
    data = bytearray(file.read_bytes())
    for match in re.finditer(b"##CC", data):
        data[match.start() + 24 + 4 * 8] = 77
    file.write_bytes(data)
    assert "unknown type" in refusal(file, "ax")


# Other formats


def tdms(folder: Path, **properties: Any) -> Path:
    channel_properties = {
        "wf_increment": 0.01,
        **{name.replace("_0_", "[0]_"): v for name, v in properties.items()},
    }
    channel = nptdms.ChannelObject("g", "ax", RAW, channel_properties)
    with nptdms.TdmsWriter(folder / "log.tdms") as writer:
        writer.write_segment([channel])
    return folder / "log.tdms"


LINEAR = {
    "NI_Number_Of_Scales": 1,
    "NI_Scale_0_Scale_Type": "Linear",
    "NI_Scale_0_Linear_Slope": 0.05,
    "NI_Scale_0_Linear_Y_Intercept": 1.0,
}


def test_scales_of_tdms_are_applied_or_refused(tmp_path: Path) -> None:
    np.testing.assert_allclose(read(tdms(tmp_path, **LINEAR), "ax", "tdms"), X * 0.05 + 1)
    odd = LINEAR | {"NI_Scale_0_Scale_Type": "Reciprocal"}
    assert "Reciprocal" in refusal(tdms(tmp_path, **odd), "ax", "tdms")
    assert "scales" in refusal(tdms(tmp_path, **LINEAR | {"NI_Number_Of_Scales": 0}), "ax", "tdms")
    done = odd | {"NI_Scaling_Status": "scaled"}
    np.testing.assert_allclose(read(tdms(tmp_path, **done), "ax", "tdms"), X)


@pytest.mark.parametrize("kind", [1, 7, 9])
def test_messages_of_another_encoding_are_refused(tmp_path: Path, kind: int) -> None:
    """In XCDR2 a number of 8 bytes stands at a multiple of 4."""
    file = tmp_path / "log.mcap"
    with file.open("wb") as stream:
        writer = mcap_ros2.writer.Writer(
            stream, compression=CompressionType.NONE, enable_crcs=False
        )
        schema = writer.register_msgdef("car/Motion", "int32 n\nfloat64 ax")
        for number in range(20):
            writer.write_message("/car", schema, {"n": 1, "ax": 0.1 * number}, number, number)
        writer.finish()  # type: ignore[no-untyped-call]
    data = file.read_bytes()
    assert data.count(b"\0\1\0\0\1\0\0\0") >= 20
    file.write_bytes(data.replace(b"\0\1\0\0\1\0\0\0", bytes([0, kind, 0, 0, 1, 0, 0, 0])))
    if kind == 1:
        np.testing.assert_allclose(read(file, "/car.ax", "mcap"), 0.1 * np.arange(20))
    else:
        assert "not plain CDR" in refusal(file, "/car.ax", "mcap")


@pytest.mark.parametrize(
    ("attributes", "fault"),
    [
        ({"scale_factor": 0.05}, "scale_factor"),
        ({"MATLAB_class": b"string"}, "is a string of MATLAB"),
        ({"MATLAB_class": b"datetime"}, "is a datetime of MATLAB"),
        ({"MATLAB_class": b"double", "MATLAB_empty": 1}, "no column"),
        ({"MATLAB_class": b"int16"}, ""),
        ({"MATLAB_class": b"logical"}, ""),
        ({}, ""),
    ],
)
def test_only_numbers_of_their_own_are_read_from_hdf5(
    tmp_path: Path, attributes: dict[str, Any], fault: str
) -> None:
    with h5py.File(tmp_path / "log.h5", "w") as root:
        root.create_dataset("ax", data=RAW).attrs.update(attributes)
    if fault:
        assert fault in refusal(tmp_path / "log.h5", "ax", "mat")
    else:
        np.testing.assert_array_equal(read(tmp_path / "log.h5", "ax", "mat"), X)
