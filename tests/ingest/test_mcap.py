"""MCAP files of ROS 2, written by the packages of its makers."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as PlainWriter
from mcap_ros2.writer import Writer

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats import mcap as mcap_log
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.source import OWN_TIME, Budget
from fleet_slip.ingest.mapping import Mapping
from tests.support.format_values import AX, AX_COUNTS, BETA_DEG, START, TIME_S, require_the_drive
from tests.support.measured import failure, own_clock, read_measured

HEADER = """std_msgs/Header header
{}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
"""A message with a header; its other fields take the place of `{}`."""
VECTOR = """================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
IMU = HEADER.format(
    "geometry_msgs/Vector3 angular_velocity\ngeometry_msgs/Vector3 linear_acceleration"
)
JOINTS = HEADER.format("string[] name\nfloat64[] velocity")
START_NS = round(START.timestamp() * 1e9)
LATE_NS = 30_000_000
"""Messages are written so much later than what they say was measured."""


def header(time_s: float) -> dict[str, Any]:
    stamp = START_NS + round(time_s * 1e9)
    return {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "base_link"}


def imu(i: int) -> dict[str, Any]:
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    acceleration = {**zero, "x": float(AX[i])}
    return {
        "header": header(TIME_S[i]),
        "angular_velocity": zero,
        "linear_acceleration": acceleration,
    }


def joints(i: int) -> dict[str, Any]:
    velocity = [0.0, float(BETA_DEG[i])]
    return {"header": header(TIME_S[i]), "name": ["fl", "fr"], "velocity": velocity}


def write(file: Path, compression: CompressionType = CompressionType.LZ4) -> Path:
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, compression=compression)
        of_imu = writer.register_msgdef("sensor_msgs/Imu", IMU + VECTOR)
        of_joints = writer.register_msgdef("sensor_msgs/JointState", JOINTS)
        for i, time_s in enumerate(TIME_S):
            written = START_NS + round(time_s * 1e9) + LATE_NS
            writer.write_message(
                "/imu/data", of_imu, imu(i), log_time=written, publish_time=written
            )
            writer.write_message("/joints", of_joints, joints(i), written, written)
        writer.finish()  # type: ignore[no-untyped-call]
    return file


def mapping(**signals: Any) -> Mapping:
    document = {
        "ax": {"column": "/imu/data.linear_acceleration.x", "unit": "m/s^2"},
        "sideslip": {"column": "/joints.velocity[1]", "unit": "deg"},
        **signals,
    }
    return own_clock(signals=document)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_messages_of_ros_2(tmp_path: Path, compression: CompressionType) -> None:
    require_the_drive(read_measured(write(tmp_path / "log.mcap", compression), mapping()))


def test_json_has_the_times_at_which_it_was_published(tmp_path: Path) -> None:
    file = write_json(tmp_path / "log.mcap", [{"a": {"x": ax}} for ax in AX])
    only = {"ax": {"column": "imu.a.x", "unit": "m/s^2"}}
    assert read_measured(file, own_clock(signals=only)).drives["ax"].to_pylist() == AX_COUNTS


def write_json(
    file: Path, messages: list[Any], encodings: tuple[str, str] = ("json", "json")
) -> Path:
    with file.open("wb") as stream:
        writer = PlainWriter(stream)
        writer.start()
        schema = writer.register_schema("imu", "jsonschema", b"{}")
        channels = [writer.register_channel("imu", encoding, schema) for encoding in encodings]
        for i, message in enumerate(messages):
            now = START_NS + i * 10**7
            writer.add_message(channels[i % 2], now, json.dumps(message).encode(), now)
        writer.finish()  # type: ignore[no-untyped-call]
    return file


def test_a_topic_of_which_a_part_cannot_be_decoded_is_refused(tmp_path: Path) -> None:
    file = write_json(tmp_path / "log.mcap", [{"a": 1.0}] * 4, ("json", "protobuf"))
    with (
        mcap_log.open_mcap(Budget.for_file(file), FileFormats()) as source,
        pytest.raises(InputError) as caught,
    ):
        list(source.batches(["imu.a"]))
    assert "topic 'imu' has messages in an encoding that is not supported ('protobuf')" in str(
        caught.value
    )


def test_a_field_is_one_of_texts_or_of_numbers(tmp_path: Path) -> None:
    messages: list[Any] = [{"a": i / 4, "b": i, "c": None, "d": str(i)} for i in range(20)]
    messages[0]["b"] = messages[17]["d"] = None
    messages[17]["c"] = 5
    file = write_json(tmp_path / "log.mcap", messages)
    with mcap_log.open_mcap(Budget.for_file(file), FileFormats()) as source:
        (base,) = source.bases(["imu.a", "imu.b", "imu.c", "imu.d"])
        rows = pl.concat(base)
        assert rows["imu.a"].to_list() == [i / 4 for i in range(20)]
        assert rows["imu.b"].to_list() == [None, *range(1, 20)]
        assert rows["imu.c"].to_list() == [None] * 17 + [5.0, None, None]
        assert rows["imu.d"].to_list() == [*map(str, range(17)), None, "18", "19"]
        assert rows[OWN_TIME].is_sorted()  # two channels of one topic, in the file's order
    messages[19]["b"] = "late"
    file = write_json(tmp_path / "log.mcap", messages)
    with mcap_log.open_mcap(Budget.for_file(file), FileFormats()) as source:
        with pytest.raises(InputError, match=r"'imu.b' has texts in some messages and numbers"):
            list(source.batches(["imu.b"]))
        with pytest.raises(InputError, match=r"no column 'imu.e'"):
            list(source.batches(["imu.e"]))


def test_a_chunk_with_a_flipped_bit_is_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "log.mcap", CompressionType.NONE)
    data = bytearray(file.read_bytes())
    at = data.index(np.float64(AX[50]).tobytes())
    data[at] ^= 1
    file.write_bytes(data)
    assert "crc validation failed" in failure(file, mapping())
