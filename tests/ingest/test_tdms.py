"""TDMS files of LabVIEW: values and times are those that were written, whatever the layout."""

import struct
from datetime import date
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nptdms import ChannelObject

from fleet_slip.ingest.formats import matlab
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.reading import open_source
from fleet_slip.ingest.formats.source import OWN_TIME
from tests.support.measured import a_mapping, failure, physical, read_measured, ticks
from tests.support.tdms_files import START, own_clock, wave, write


def read(file: Path, *columns: str) -> pl.DataFrame:
    with open_source(file, FileFormats()) as source:
        return pl.concat(source.batches(columns))


def test_groups_of_several_rates_are_one_drive(tmp_path: Path) -> None:
    fast, slow = np.arange(0, 2, 0.01), np.arange(0, 2, 0.1)
    ax = ChannelObject("imu", "ax", np.round(fast, 3), wave(0.01))
    beta = ChannelObject("label", "beta", slow, wave(0.1))
    log = read_measured(write(tmp_path / "log.tdms", [ax, beta]), own_clock())
    assert ticks(log) == list(range(200))
    np.testing.assert_allclose(physical(log, "ax", 0.001), fast, atol=1e-9)
    sideslip = physical(log, "sideslip", 0.0001)[:191]
    np.testing.assert_allclose(sideslip, np.radians(fast[:191]), atol=5.1e-5)
    assert log.drives["day"].unique().to_pylist() == [START.date()]


def test_a_column_of_timestamps_is_the_time(tmp_path: Path) -> None:
    moments = np.datetime64(START.replace(tzinfo=None)) + np.arange(100) * np.timedelta64(10, "ms")
    channels = {"Zeit": moments, "ax": np.arange(100) / 100, "beta": np.zeros(100)}
    objects = [ChannelObject("g", name, values) for name, values in channels.items()]
    file = write(tmp_path / "log.tdms", objects)
    mapping = a_mapping(time={"column": "Zeit", "unit": None}, drive={"day": None})
    log = read_measured(file, mapping)
    assert ticks(log) == list(range(100))
    assert log.drives["day"].unique().to_pylist() == [START.date()]
    assert "no clock" in failure(file, own_clock())


def test_a_channel_of_several_groups_is_named_with_its_group(tmp_path: Path) -> None:
    both = [ChannelObject(group, "ax", np.ones(50), wave(0.01)) for group in "ab"]
    file = write(tmp_path / "log.tdms", both)
    mapping = own_clock(signals={"ax": {"column": "ax", "unit": "m/s^2"}})
    assert "Its columns are 'ax@a', 'ax@b'." in failure(file, mapping)
    assert read(file, "ax@b")["ax@b"].to_list() == [1.0] * 50


def test_a_waveform_without_a_start_needs_a_day(tmp_path: Path) -> None:
    ax = ChannelObject("g", "ax", np.ones(50), {"wf_increment": 0.01, "wf_start_offset": 3.0})
    beta = ChannelObject("g", "beta", np.ones(50), {"wf_increment": 0.01, "wf_start_offset": 3.0})
    file = write(tmp_path / "log.tdms", [ax, beta])
    assert "day" in failure(file, own_clock())
    assert read(file, "ax")[OWN_TIME][0] == 3.0
    read_measured(file, own_clock(drive={"day": date(2024, 5, 31)}))


@settings(max_examples=30, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=4),
    kind=st.sampled_from(["i2", "u4", "f4", "f8"]),
    ahead=st.integers(1, 7),
    seed=st.integers(0, 99),
)
def test_values_do_not_depend_on_segments_or_blocks(
    tmp_path_factory: pytest.TempPathFactory,
    lengths: list[int],
    kind: str,
    ahead: int,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 2**15, sum(lengths)).astype(kind)
    ends = np.cumsum(lengths)
    scale = {
        "NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Linear",
        "NI_Scale[0]_Linear_Slope": 0.5, "NI_Scale[0]_Linear_Y_Intercept": 2.0,
        "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF,
    }  # fmt: skip
    file = write(
        tmp_path_factory.mktemp("tdms") / "log.tdms",
        *[
            [
                ChannelObject("a", "plain", values[end - rows : end], wave(0.01)),
                ChannelObject("b", "scaled", values[end - rows : end], wave(0.1, **scale)),
            ]
            for rows, end in zip(lengths, ends, strict=True)
        ],
    )
    with mock.patch.object(matlab, "WINDOW_ROWS", ahead):
        samples = read(file, "plain")
        assert samples["plain"].to_list() == values.astype(float).tolist()
        assert read(file, "scaled")["scaled"].to_list() == (0.5 * values + 2.0).tolist()
    step = np.arange(len(values)) * 0.01
    np.testing.assert_allclose(samples[OWN_TIME] - START.timestamp(), step, atol=1e-6)


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def a_segment(rows: np.ndarray[Any, Any]) -> bytes:
    """A segment by the description of National Instruments: 16-bit channels x and y."""
    objects = struct.pack("<I", rows.shape[1])
    for name in "xy"[: rows.shape[1]]:
        objects += text(f"/'g'/'{name}'") + struct.pack("<I", 20)
        objects += struct.pack("<IIQ", 2, 1, len(rows)) + struct.pack("<I", 1)
        objects += text("wf_increment") + struct.pack("<Id", 10, 0.01)
    data = rows.T.astype("<i2").tobytes()
    sizes = struct.pack("<IQQ", 4713, len(objects) + len(data), len(objects))
    return b"TDSm" + struct.pack("<I", 2 | 4 | 8) + sizes + objects + data


def test_a_file_that_ends_too_early_is_refused_wherever_it_was_cut(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "log.tdms"
    content = a_segment(np.ones((30, 2)))
    for cut in [
        5,
        27,
        40,
        len(content) - 1,
        len(content) + 5,
        len(content) + 60,
        2 * len(content) - 1,
    ]:
        file.write_bytes((content + content)[:cut])
        assert "ends too early" in failure(file, own_clock()), cut
    assert not caplog.records  # npTDMS would write its own words to the terminal


def test_an_index_beside_a_file_is_not_believed(tmp_path: Path) -> None:
    file = write(tmp_path / "log.tdms", [ChannelObject("g", "x", np.arange(5), wave(0.01))])
    (tmp_path / "log.tdms_index").write_bytes(b"TDSh" + bytes(24))
    assert read(file, "x")["x"].to_list() == [0, 1, 2, 3, 4]
    assert "not a TDMS file" in failure(tmp_path / "log.tdms_index", own_clock())


def test_counts_of_a_converter_are_refused(tmp_path: Path) -> None:
    objects = struct.pack("<I", 1) + text("/'g'/'x'") + struct.pack("<I", 0x1269)
    objects += struct.pack("<IIQ", 0xFFFFFFFF, 1, 4)  # raw data of DAQmx
    objects += struct.pack("<IIIIII", 1, 3, 0, 0, 0, 0) + struct.pack("<II", 1, 2)
    objects += struct.pack("<I", 0)
    sizes = struct.pack("<IQQ", 4713, len(objects) + 8, len(objects))
    file = tmp_path / "log.tdms"
    file.write_bytes(b"TDSm" + struct.pack("<I", 0x8E) + sizes + objects + bytes(8))
    assert "raw data of DAQmx" in failure(file, own_clock())


def test_a_file_without_values_is_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "log.tdms", [ChannelObject("g", "x", np.zeros(0), wave(0.01))])
    assert "it has no values" in failure(file, own_clock())
