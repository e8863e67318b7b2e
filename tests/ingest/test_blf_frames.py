"""Frames of BLF files are those that python-can reads, one after the other."""

import struct
import zlib
from pathlib import Path
from typing import Any
from unittest import mock

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats import can_files
from fleet_slip.ingest.formats.can_files import read_blf_frames
from fleet_slip.ingest.formats.source import Budget

Frame = tuple[float, int, bool, int, bytes]


def expected(file: Path) -> list[Any]:
    with can.BLFReader(file) as trace:
        return [
            (f.timestamp, f.arbitration_id, f.is_extended_id, f.channel, bytes(f.data))
            for f in trace
            if not (f.is_error_frame or f.is_remote_frame)
        ]


def read(file: Path) -> list[Frame]:
    with can.BLFReader(file) as trace:
        start_s = trace.start_timestamp
    found: list[Frame] = []
    for block in read_blf_frames(Budget.of(file), start_s):
        columns = [column.tolist() for column in vars(block).values()]
        for number, extended, time_s, bus, size, data in zip(*columns, strict=True):
            found.append((time_s, number, extended, bus, bytes(data[:size])))
    return found


@st.composite
def messages(draw: st.DrawFn) -> can.Message:
    extended, kind = draw(st.booleans()), draw(st.sampled_from(["data", "remote", "error", "fd"]))
    sizes = [*range(9), 12, 16, 20, 24, 32, 48, 64] if kind == "fd" else range(9)
    size = draw(st.sampled_from(sizes))
    mark = b"" if draw(st.booleans()) else b"LOBJ"[:size]
    return can.Message(
        timestamp=1.7e9 + draw(st.integers(0, 10**9)) / 1e6,
        arbitration_id=draw(st.integers(0, 2**29 - 1 if extended else 2**11 - 1)),
        is_extended_id=extended,
        is_remote_frame=kind == "remote",
        is_error_frame=kind == "error",
        is_fd=kind == "fd",
        channel=draw(st.integers(0, 3)),
        dlc=size,
        data=None if kind == "remote" else mark + draw(st.binary(min_size=64))[: size - len(mark)],
    )


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(st.lists(messages(), max_size=40), st.integers(300, 2000), st.integers(1, 3000))
def test_frames_are_those_that_python_can_reads(
    tmp_path: Path, frames: list[can.Message], container: int, at_once: int
) -> None:
    file = tmp_path / "log.blf"
    with can.BLFWriter(file) as trace:
        trace.max_container_size = container  # of one object or more, or python-can cuts the last
        for number, frame in enumerate(frames):
            trace.on_message_received(frame)
            if number % 7 == 3:
                trace.log_event("a remark of an odd length" + "!" * (number % 4))
    with mock.patch.object(can_files, "_AT_ONCE", at_once):
        assert read(file) == expected(file)


def write_objects(file: Path, *objects: bytes) -> Path:
    with can.BLFWriter(file) as trace:
        trace.on_message_received(can.Message(timestamp=1.7e9, arbitration_id=1))
    head = file.read_bytes()[:144]
    content = b"".join(objects)
    header = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(content), 10)
    file.write_bytes(head + header + struct.pack("<H6xI4x", 0, len(content)) + content)
    return file


def fd_64(version: int, payload: bytes, *, valid: int, further: bytes = b"") -> bytes:
    """A frame as CANoe writes it: of as many bytes as it has, other data behind them."""
    size = {1: 32, 2: 40}[version]
    behind = size + 40 + len(payload) if further else 0
    body = struct.pack(
        "<BBBBLLLLLLLHBBL", 2, 15, valid, 0, 0x80000123, 0, 0x1000, 0, 0, 0, 0, 0, 0, behind, 0
    )
    timed = struct.pack("<LHHQ", 2, 0, 0, 12_345) + bytes(size - 32)
    whole = len(timed) + 16 + len(body) + len(payload) + len(further)
    return (
        struct.pack("<4sHHII", b"LOBJ", size, version, whole, 101)
        + timed
        + body
        + payload
        + further
    )


@pytest.mark.parametrize("version", [1, 2])
def test_frames_of_flexible_size(tmp_path: Path, version: int) -> None:
    file = write_objects(
        tmp_path / "log.blf",
        fd_64(version, b"abcd", valid=4),
        fd_64(version, b"abcd", valid=12),  # eight bytes are said to be there, and are not
        fd_64(version, b"abcdefgh", valid=6, further=b"12345678"),
        fd_64(version, bytes(range(64)), valid=64),
    )
    found = read(file)
    assert found == expected(file)
    assert [frame[-1] for frame in found[:3]] == [b"abcd", b"abcd" + bytes(8), b"abcdef"]


def damaged(file: Path) -> str:
    with pytest.raises(InputError) as caught:
        read(file)
    return str(caught.value)


def test_what_no_recorder_writes_is_refused(tmp_path: Path) -> None:
    one: Any = fd_64(1, b"abcd", valid=4)
    file = tmp_path / "log.blf"
    assert "no object where the next should begin" in damaged(write_objects(file, one, bytes(40)))
    short = one[:8] + struct.pack("<I", 40) + one[12:40]
    assert "a frame of 40 bytes" in damaged(write_objects(file, short, one))
    assert "a last object that ends too early" in damaged(write_objects(file, one, one[:-4]))
    content = write_objects(file, one).read_bytes()
    file.write_bytes(write_objects(file, one, one).read_bytes()[: -len(one)])
    assert "a container that ends too early" in damaged(file)
    file.write_bytes(content[:160] + b"\7" + content[161:])
    assert "compressed by an unknown method, 7" in damaged(file)
    packed = zlib.compress(one * 9)[:-6]  # its last frames are not there
    header = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(packed), 10)
    file.write_bytes(content[:144] + header + struct.pack("<H6xI4x", 2, 9 * len(one)) + packed)
    assert "incomplete or truncated stream" in damaged(file)
    file.write_bytes(content + b"rest")
    assert "no object at byte" in damaged(file)
