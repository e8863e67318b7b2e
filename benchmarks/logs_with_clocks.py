"""Logs with several time bases, of every format that has them, as large as asked for."""

import struct
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.support.ros2 import HEADER

BASES: dict[str, tuple[int, float, dict[str, str]]] = {
    "Imu": (100, 0.0, {"ax": "m/s^2", "ay": "m/s^2", "yaw_rate": "rad/s"}),
    "Wheels": (100, 0.003, {f"wheel_{place}": "rad/s" for place in ("fl", "fr", "rl", "rr")}),
    "Steering": (
        50, 0.001, {"steering_wheel": "rad", "steer_fl": "rad", "steer_fr": "rad"},
    ),
    "Label": (250, 0.0, {"sideslip": "rad"}),
}  # fmt: skip
"""Rate in Hz, when the first sample is, and signals of each time base."""
ROWS_PER_S = sum(rate for rate, _, _ in BASES.values())
PIECE_S, DRIVE_S, PAUSE_S = 200, 1800, 10
START_S = 1_717_156_800
SCALE = 0.001

Counts = NDArray[np.int16]
Piece = dict[str, tuple[NDArray[np.float64], Counts]]


def pieces(rows: int, *, piece_s: int = PIECE_S) -> Iterator[Piece]:
    """Yield the times in s and the counts of each base, some seconds at a time."""
    for start in range(0, rows // ROWS_PER_S, piece_s):
        end = min(start + piece_s, rows // ROWS_PER_S)
        rng = np.random.default_rng(start)
        piece = {}
        for name, (rate, offset, signals) in BASES.items():
            since = np.arange(start * rate, end * rate) / rate
            time_s = np.round(since + since // DRIVE_S * PAUSE_S + offset, 6)
            waves = [0.5 * np.sin(time_s * (1 + i / 7)) for i in range(len(signals))]
            noisy = np.stack(waves, axis=1) + rng.normal(0, 0.05, (since.size, len(signals)))
            piece[name] = time_s, np.rint(noisy / SCALE).astype("<i2")
        yield piece


def write_mdf(file: Path, parts: Iterable[Piece]) -> None:
    from asammdf import MDF, Signal  # noqa: PLC0415 - of an extra

    factor: Any = {"a": SCALE, "b": 0.0}
    with MDF(version="4.10") as mdf:
        for number, piece in enumerate(parts):
            for group, (name, (time_s, counts)) in enumerate(piece.items()):
                if number:
                    mdf.extend(group, [(time_s, None), *((one, None) for one in counts.T)])
                    continue
                names = zip(BASES[name][2], counts.T, strict=True)
                mdf.append([Signal(one, time_s, name=n, conversion=factor) for n, one in names])
        mdf.save(file, compression=2)


def write_as_one(folder: Path, parts: Iterable[Piece]) -> None:
    folder.mkdir()
    waiting: list[Piece] = []
    number = count()
    for piece in parts:
        waiting.append(piece)
        if len(waiting) == 3:
            write_mdf(folder / f"{next(number):06}.mf4", waiting)
            waiting = []
    if waiting:
        write_mdf(folder / f"{next(number):06}.mf4", waiting)


def frames_of(piece: Piece) -> Iterator[tuple[float, int, bytes]]:
    """Yield time, number and payload of the frames of all messages, in the order of time."""
    times, numbers, payloads = [], [], []
    for number, (time_s, counts) in enumerate(piece.values()):
        padded = np.zeros((len(counts), 4), dtype="<i2")
        padded[:, : counts.shape[1]] = counts
        times.append(time_s)
        numbers.append(np.full(time_s.size, number))
        payloads.append(padded.view("V8").ravel())
    whole = np.concatenate(times)
    order = np.argsort(whole, kind="stable")
    yield from zip(
        whole[order].tolist(),
        np.concatenate(numbers)[order].tolist(),
        np.concatenate(payloads)[order].tolist(),
        strict=True,
    )


def write_can(file: Path, parts: Iterable[Piece]) -> None:
    with file.open("w") as sink:
        for piece in parts:
            sink.writelines(
                f"({START_S + time:.6f}) can0 {256 + number:03X}#{payload.hex()}\n"
                for time, number, payload in frames_of(piece)
            )


def write_blf(file: Path, parts: Iterable[Piece]) -> None:
    import can  # noqa: PLC0415 - of an extra

    with can.BLFWriter(file, channel=0, compression_level=1) as trace:
        for piece in parts:
            for time, number, payload in frames_of(piece):
                trace.on_message_received(
                    can.Message(
                        START_S + time, 256 + number, is_extended_id=False, data=payload, channel=0
                    )
                )


def write_bus(file: Path, parts: Iterable[Piece]) -> None:
    from asammdf import MDF, Signal  # noqa: PLC0415
    from asammdf.blocks.v4_blocks import SourceInformation  # noqa: PLC0415
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS  # noqa: PLC0415

    kind = np.dtype(
        [
            ("CAN_DataFrame.BusChannel", "<u1"), ("CAN_DataFrame.ID", "<u4"),
            ("CAN_DataFrame.IDE", "<u1"), ("CAN_DataFrame.DLC", "<u1"),
            ("CAN_DataFrame.DataLength", "<u1"), ("CAN_DataFrame.DataBytes", "(8,)u1"),
        ]
    )  # fmt: skip
    with MDF(version="4.10") as mdf:
        for first, piece in enumerate(parts):
            found = list(frames_of(piece))
            frames = np.zeros(len(found), dtype=kind)
            time_s = np.array([time for time, _, _ in found])
            frames["CAN_DataFrame.BusChannel"] = 1
            frames["CAN_DataFrame.ID"] = [256 + number for _, number, _ in found]
            frames["CAN_DataFrame.DLC"] = frames["CAN_DataFrame.DataLength"] = 8
            frames["CAN_DataFrame.DataBytes"] = np.frombuffer(
                b"".join(payload for _, _, payload in found), dtype="u1"
            ).reshape(-1, 8)
            if first:
                mdf.extend(0, [(time_s, None), (frames, None)])
            else:
                source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
                mdf.append(Signal(frames, time_s, name="CAN_DataFrame", source=source))
        mdf.save(file, compression=2)


def write_mcap(file: Path, parts: Iterable[Piece]) -> None:
    from mcap.writer import Writer  # noqa: PLC0415

    with file.open("wb") as sink:
        writer = Writer(sink)
        writer.start("ros2", "benchmark")
        channels = []
        for name, (_, _, signals) in BASES.items():
            text = HEADER.format("\n".join(f"float64 {signal}" for signal in signals))
            schema = writer.register_schema(f"test/{name}", "ros2msg", text.encode())
            channels.append(writer.register_channel(f"/{name}", "cdr", schema))
        sizes = [len(signals) for _, _, signals in BASES.values()]
        for piece in parts:
            for time, number, payload in frames_of(piece):
                counts = np.frombuffer(payload, dtype="<i2")[: sizes[number]]
                sec, nanosec = START_S + int(time), round(time % 1 * 1e9)
                head = struct.pack("<4siII2s2x", b"\0\1\0\0", sec, nanosec, 2, b"b\0")
                at = sec * 10**9 + nanosec
                data = head + (counts * SCALE).tobytes()
                writer.add_message(channels[number], at, data, at)
        writer.finish()  # type: ignore[no-untyped-call]


def write_mat5(file: Path, parts: Iterable[Piece]) -> None:
    import scipy.io  # noqa: PLC0415

    found = list(parts)
    scipy.io.savemat(file, {name: _vectors(name, found) for name in BASES}, do_compression=True)


def write_mat73(file: Path, parts: Iterable[Piece]) -> None:
    import h5py  # noqa: PLC0415

    with h5py.File(file, "w", userblock_size=512) as root:
        for piece in parts:
            for name in BASES:
                group = root.require_group(name)
                for field, values in _vectors(name, [piece]).items():
                    if field not in group:
                        group.create_dataset(
                            field, shape=(1, 0), maxshape=(1, None), dtype="f8",
                            chunks=(1, 2**14), compression="gzip", compression_opts=1,
                        )  # fmt: skip
                    one = group[field]
                    one.resize(one.shape[1] + values.size, axis=1)
                    one[0, -values.size :] = values


def _vectors(name: str, found: list[Piece]) -> dict[str, NDArray[np.float64]]:
    """Return the times and the signals of a base, by name."""
    times = np.concatenate([piece[name][0] for piece in found])
    counts = np.concatenate([piece[name][1] for piece in found])
    return {"t": times, **{n: counts[:, i] * SCALE for i, n in enumerate(BASES[name][2])}}


WRITERS: dict[str, tuple[str, str, Callable[[Path, Iterable[Piece]], None]]] = {
    "mdf": ("log.mf4", "{signal}", write_mdf),
    "mcap": ("log.mcap", "/{base}.{signal}", write_mcap),
    "can": ("log.log", "{base}.{signal}", write_can),
    "blf": ("log.blf", "{base}.{signal}", write_blf),
    "bus": ("bus.mf4", "{base}.{signal}", write_bus),
    "mat5": ("log5.mat", "{base}.{signal}", write_mat5),
    "mat73": ("log73.mat", "{base}.{signal}", write_mat73),
    "as-one": ("parts", "{signal}", write_as_one),
}
"""For each format the file's name, what a signal is called, and what writes it."""


def write_mapping(folder: Path, kind: str) -> Path:
    """Write the mapping of such logs, and the database of their messages."""
    named, of_mat = WRITERS[kind][1], kind.startswith("mat")
    lines = ['name = "speed"', "[time]"]
    lines += ['column = "Imu.t"', 'unit = "s"'] if of_mat else ["own_clock = true"]
    if kind in {"can", "blf", "bus"}:
        lines += ["[can]", 'database = "car.dbc"']
        text = "".join(
            f"BO_ {256 + number} {base}: 8 E\n"
            + "".join(
                f' SG_ {signal} : {16 * place}|16@1- ({SCALE},0) [0|0] "" E\n'
                for place, signal in enumerate(signals)
            )
            for number, (base, (_, _, signals)) in enumerate(BASES.items())
        )
        (folder / "car.dbc").write_text(f'VERSION ""\nNS_ :\nBS_:\nBU_: E\n{text}')
    lines += ["[drive]", "day = 2024-05-31", 'vehicle_id = "a"', 'vehicle_model = "b"', "[signals]"]
    for base, (_, _, signals) in BASES.items():
        own = f', time = "{base}.t"' if of_mat and base != "Imu" else ""
        for signal, unit in signals.items():
            column = named.format(base=base, signal=signal)
            lines.append(f'{signal} = {{ column = "{column}", unit = "{unit}"{own} }}')
    (folder / "mapping.toml").write_text("\n".join(lines) + "\n")
    return folder / "mapping.toml"
