"""Measured files of the formats of test departments, as other programs write them, then damaged."""

import io
import random
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal

import can
import h5py
import mcap_ros2.writer
import nptdms
import numpy as np
import polars as pl
import pyarrow as pa
import scipy.io
from asammdf import MDF, Signal

from fleet_slip.ingest.formats.file_formats import CanBus
from fleet_slip.ingest.mapping import Mapping
from tests.support.catalog import SIGNALS
from tests.support.fuzz.files import _BASE
from tests.support.fuzz.mutate import mutate_bytes

ROWS = 60
TIME_S = np.arange(ROWS) / 100
AX, BETA = 0.1 * np.arange(ROWS) - 1, 0.01 * np.arange(ROWS)
START = datetime(2024, 5, 31, 12, tzinfo=UTC)
DBC = """VERSION ""
BU_: ECU
BO_ 256 Motion: 8 ECU
 SG_ ax : 0|16@1- (0.001,0) [0|0] "m/s2" ECU
 SG_ beta : 16|16@1- (0.01,0) [0|0] "deg" ECU
"""
MESSAGE = f"""car/Vector a
float64 beta
string note
{"=" * 80}
MSG: car/Vector
float64 x
"""
_BUS = CanBus(database="car.dbc", text=DBC)


def _mapping(ax: str, beta: str, **changes: Any) -> Mapping:
    signals = {"ax": {"column": ax, "unit": "m/s^2"}, "sideslip": {"column": beta, "unit": "deg"}}
    mapping = Mapping.model_validate({**_BASE, "signals": signals, **changes}, context=SIGNALS)
    # The database was read when a mapping is loaded; here it is given.
    return mapping.model_copy(update={"can": _BUS}) if "can" in changes else mapping


@dataclass(frozen=True)
class Format:
    """How a file of a format is made, and the mapping that fits it."""

    suffix: str
    write: Callable[[Path], object]
    mapping: Mapping


def _mdf(version: str, compression: Literal[0, 2]) -> Callable[[Path], object]:
    def write(file: Path) -> None:
        with MDF(version=version) as mdf:
            mdf.start_time = START
            invalid = np.arange(ROWS) % 7 == 0 if version >= "4" else None
            counts = np.rint(AX * 1000).astype("i2")
            mdf.append([Signal(counts, TIME_S, name="ax", conversion=_MILLI)])
            mdf.append([Signal(BETA, TIME_S, name="beta", invalidation_bits=invalid)])
            mdf.append([Signal(np.array([b"text"] * 9), TIME_S[:9], name="t", encoding="utf-8")])
            mdf.save(file, compression=compression, overwrite=True)

    return write


def _unfinalised(file: Path) -> None:
    _mdf("4.10", 0)(file)
    data = bytearray(file.read_bytes())
    data[:8], data[60] = b"UnFinMF ", 1
    file.write_bytes(data)


def _mcap(file: Path) -> None:
    with file.open("wb") as stream:
        writer = mcap_ros2.writer.Writer(stream, chunk_size=500)
        motion = writer.register_msgdef("car/Motion", MESSAGE)
        for time_s, ax, beta in zip(TIME_S, AX, BETA, strict=True):
            now = round((START.timestamp() + time_s) * 1e9)
            message = {"a": {"x": float(ax)}, "beta": float(beta), "note": "text"}
            writer.write_message("/car", motion, message, log_time=now, publish_time=now)
        writer.finish()  # type: ignore[no-untyped-call]


_MILLI: dict[str, object] = {"a": 0.001, "b": 0.0}


def _trace(make: Callable[[Path], Any]) -> Callable[[Path], object]:
    def write(file: Path) -> None:
        with make(file) as trace:
            for time_s, ax, beta in zip(TIME_S, AX, BETA, strict=True):
                counts = np.rint([ax * 1000, beta * 100]).astype("<i2").tobytes()
                data = counts + b"\0" * 4
                trace.on_message_received(
                    can.Message(
                        START.timestamp() + time_s,
                        arbitration_id=256,
                        is_extended_id=False,
                        data=data,
                        channel=1,
                    )
                )

    return write


def _mat73(file: Path) -> None:
    with h5py.File(file, "w", userblock_size=512) as root:
        for name, values in (("t", TIME_S), ("ax", AX), ("Data/beta", BETA)):
            root.create_dataset(name, data=values, compression="gzip")
    with file.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\x02IM")


def _tdms(file: Path) -> None:
    wave = {"wf_start_time": START.replace(tzinfo=None), "wf_increment": 0.01, "unit_string": "g"}
    with nptdms.TdmsWriter(file) as writer:
        for rows in (slice(40), slice(40, ROWS)):
            ax = nptdms.ChannelObject("car", "ax", AX[rows], wave)
            note = nptdms.ChannelObject("car", "note", ["text"] * len(AX[rows]), wave)
            writer.write_segment([ax, nptdms.ChannelObject("gps", "beta", BETA[rows], wave), note])


def _csv(file: Path) -> None:
    pl.DataFrame({"t": TIME_S, "ax": AX, "beta": BETA}).write_csv(file)


def _vbo(file: Path) -> None:
    head = ["File created on 31/05/2024 at 12:00:00", "[header]", "", "[column names]"]
    head += ["sats time lat long velocity heading ax beta", "", "[data]"]
    rows = [
        f"009 1200{t:05.2f} +03120.0 +00060.0 040.0 093.5 {ax:+.4f} {beta:+.4f}"
        for t, ax, beta in zip(TIME_S, AX, BETA, strict=True)
    ]
    file.write_text("\r\n".join([*head, *rows, ""]))


def _compressed(file: Path) -> None:
    plain = io.BytesIO()
    pl.DataFrame({"t": TIME_S, "ax": AX, "beta": BETA}).write_csv(plain)
    with pa.CompressedOutputStream(str(file), "zstd") as stream:
        stream.write(plain.getvalue())


_OWN = {"time": {"own_clock": True}, "drive": {**_BASE["drive"]}}
_CAN = {**_OWN, "can": {"database": "car.dbc"}}
FORMATS: dict[str, Format] = {
    "mdf3": Format(".mdf", _mdf("3.30", 0), _mapping("ax", "beta", **_OWN)),
    "mdf4": Format(".mf4", _mdf("4.10", 0), _mapping("ax", "beta", **_OWN)),
    "mdf4_compressed": Format(".mf4", _mdf("4.20", 2), _mapping("ax", "beta", **_OWN)),
    "mdf4_unfinalised": Format(".mf4", _unfinalised, _mapping("ax", "beta", **_OWN)),
    "mcap": Format(".mcap", _mcap, _mapping("/car.a.x", "/car.beta", **_OWN)),
    "mdf_bus": Format(".mf4", _trace(can.MF4Writer), _mapping("Motion.ax", "Motion.beta", **_CAN)),
    "blf": Format(".blf", _trace(can.BLFWriter), _mapping("Motion.ax", "Motion.beta", **_CAN)),
    "asc": Format(".asc", _trace(can.ASCWriter), _mapping("Motion.ax", "Motion.beta", **_CAN)),
    "candump": Format(
        ".log", _trace(can.CanutilsLogWriter), _mapping("Motion.ax", "Motion.beta", **_CAN)
    ),
    "tdms": Format(".tdms", _tdms, _mapping("ax", "beta", **_OWN)),
    "mat5": Format(
        ".mat",
        lambda file: scipy.io.savemat(file, {"t": TIME_S, "ax": AX, "Data": {"beta": BETA}}),
        _mapping("ax", "Data.beta"),
    ),
    "mat73": Format(".mat", _mat73, _mapping("ax", "Data.beta")),
    "vbo": Format(".vbo", _vbo, _mapping("ax", "beta", **_OWN)),
    "csv_zst": Format(".csv.zst", _compressed, _mapping("ax", "beta")),
}


@cache
def sound_file(name: str) -> bytes:
    """Return a file of a format in which nothing is wrong, made once in a process."""
    log_format = FORMATS[name]
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()):
        file = Path(folder, f"log{log_format.suffix}")
        log_format.write(file)
        return file.read_bytes()


def damaged_file(rng: random.Random) -> tuple[bytes, Format]:
    """Return a file of any format, mostly damaged or with another's name, and its format."""
    name = rng.choice(list(FORMATS))
    data = sound_file(name)
    if rng.random() < 0.95:
        data = mutate_bytes(rng, data, edges=rng.choice([0, 64, 400]))
    other = rng.choice(list(FORMATS)) if rng.random() < 0.05 else name
    return data, Format(FORMATS[other].suffix, FORMATS[name].write, FORMATS[name].mapping)
