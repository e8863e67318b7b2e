"""CAN traces written byte by byte as by Vector's tools, not by python-can, which reads them."""

import struct
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

HEAD = "date Fri May 31 12:00:00.000 pm 2024\nbase hex  timestamps {}\ninternal events logged\n"
TRIGGER = "Begin Triggerblock Fri May 31 12:00:00.000 pm 2024\n   0.000000 Start of measurement\n"


class Frame(NamedTuple):
    """A frame of CAN, or of CAN FD; buses are counted from 1."""

    time_s: float
    bus: int
    number: int
    data: bytes
    fd: bool = False


def asc_line(frame: Frame) -> str:
    """Return the line of a frame."""
    data, size = frame.data.hex(" ").upper(), len(frame.data)
    if frame.fd:
        end = f"{frame.number:x} 1 0 {size:x} {size} {data}"
        return f"{frame.time_s:11.6f} CANFD {frame.bus:3} Rx {end}"
    return f"{frame.time_s:11.6f} {frame.bus}  {frame.number:X}             Rx   d {size} {data}"


def write_asc(file: Path, lines: Iterable[str], timestamps: str = "absolute") -> Path:
    """Write lines between the head and the end of a trace."""
    body = "\n".join(lines)
    file.write_text(f"{HEAD.format(timestamps)}{TRIGGER}{body}\nEnd TriggerBlock\n", "cp1252")
    return file


def write_blf(file: Path, frames: Iterable[Frame], start: datetime) -> Path:
    """Write frames in one container that is not compressed; times are since the start."""
    objects = b""
    for frame in frames:
        flags_fd = 1 if frame.fd else 0
        if frame.fd:  # CAN_FD_MESSAGE: 64 bytes of data
            kind = 100
            body = struct.pack(
                "<HBBLLBBB5x64s",
                frame.bus, 0, len(frame.data), frame.number, 0, 0, flags_fd, len(frame.data),
                frame.data,
            )  # fmt: skip
        else:  # CAN_MESSAGE
            kind = 1
            body = struct.pack("<HBBL8s", frame.bus, 0, len(frame.data), frame.number, frame.data)
        size = 32 + len(body)
        head = struct.pack(
            "<4sHHLLLHHQ", b"LOBJ", 32, 1, size, kind, 2, 0, 0, round(frame.time_s * 1e9)
        )
        objects += head + body + b"\0" * (size % 4)
    container = struct.pack("<H6xL4x", 0, len(objects)) + objects
    size = 16 + len(container)
    body = struct.pack("<4sHHLL", b"LOBJ", 16, 1, size, 10) + container + b"\0" * (size % 4)
    day = (start.isoweekday() % 7,)
    moment = (start.year, start.month, *day, start.day, start.hour, start.minute, start.second, 0)
    head = struct.pack(
        "<4sLBBBBBBBBQQLL8H8H", b"LOGG", 144, 0, 0, 0, 0, 2, 6, 8, 1,
        144 + len(body), 144 + len(objects), 2, 0, *moment, *moment,
    )  # fmt: skip
    file.write_bytes(head.ljust(144, b"\0") + body)
    return file
