"""Measured files that point elsewhere, or stand for far more than they are: refused, and at once.

They are made with the packages of their formats, as an attacker would.
"""

import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from asammdf import MDF, Signal

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats import source
from fleet_slip.ingest.formats.file_formats import CanBus
from fleet_slip.ingest.mapping import Mapping
from tests.support.commands import within
from tests.support.fuzz.logs import DBC, FORMATS, sound_file
from tests.support.measured import OWN_CLOCK, a_mapping, read_measured

COLUMNS = ("t", "ax", "beta")
SECRET = 12_345.0
"""The content of a file that a log must not be able to read."""
ROWS = 100


def failure(file: Path, mapping: Mapping | None = None) -> str:
    with within(), pytest.raises(InputError) as caught:
        read_measured(file, mapping or a_mapping())
    assert "\n" not in str(caught.value)
    assert str(SECRET) not in str(caught.value)
    return str(caught.value)


def values(column: str) -> Any:
    return np.arange(ROWS) / 100 * (1 if column == "t" else 0.1)


# HDF5


def hdf5(folder: Path, make: Callable[[h5py.File, str], object]) -> Path:
    """A file that is sound but for ax and beta, which are made otherwise."""
    file = folder / "log.h5"
    with h5py.File(file, "w") as root:
        root["t"] = values("t")
        for column in COLUMNS[1:]:
            make(root, column)
    return file


def secret(folder: Path) -> Path:
    """Another file, which has the values of both kinds of storage."""
    file = folder / "secret.h5"
    with h5py.File(file, "w") as root:
        root["x"] = np.full(ROWS, SECRET)
    return file


@pytest.mark.parametrize("place", ["{}", "below/{}"])
def test_values_in_another_file_or_a_pipe_are_not_read(tmp_path: Path, place: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    for other in (secret(tmp_path), tmp_path / "pipe"):
        outside = [(str(other), 0, h5py.h5f.UNLIMITED)]

        def make(root: h5py.File, column: str, outside: Any = outside) -> None:
            root.create_dataset(place.format(column), (ROWS,), dtype="f8", external=outside)

        assert "are in other files" in failure(hdf5(tmp_path, make))


@pytest.mark.parametrize("is_unlimited", [False, True])
def test_a_virtual_dataset_is_not_read(tmp_path: Path, is_unlimited: bool) -> None:
    other = secret(tmp_path)
    max_shape = (None,) if is_unlimited else (ROWS,)

    def make(root: h5py.File, column: str) -> None:
        layout = h5py.VirtualLayout((ROWS,), "f8", maxshape=max_shape)
        layout[: h5py.h5s.UNLIMITED if is_unlimited else ROWS] = h5py.VirtualSource(
            str(other), "x", (ROWS,), maxshape=max_shape
        )[: h5py.h5s.UNLIMITED if is_unlimited else ROWS]
        root.create_virtual_dataset(column, layout)

    assert "are in other files" in failure(hdf5(tmp_path, make))


def test_links_are_not_followed(tmp_path: Path) -> None:
    other = secret(tmp_path)

    def outside(root: h5py.File, column: str) -> None:
        root[column] = h5py.ExternalLink(str(other), "x")

    def within_it(root: h5py.File, column: str) -> None:
        root[column] = h5py.SoftLink("/t")

    def group(root: h5py.File, column: str) -> None:
        root[f"{column}_of"] = h5py.ExternalLink(str(other), "/")

    assert "'ax' is a link, which is not followed" in failure(hdf5(tmp_path, outside))
    assert "'ax' is a link, which is not followed" in failure(hdf5(tmp_path, within_it))
    signals = {name: {"column": f"{name}_of.x", "unit": "m/s^2"} for name in ("ax", "ay")}
    message = failure(hdf5(tmp_path, group), a_mapping(signals=signals))
    assert "'ax_of.x' is a link, which is not followed" in message


def test_rows_that_stand_nowhere_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "FREE_MEMORY", 2**27)
    monkeypatch.setattr(source, "FREE_ROWS", 10**5)
    rows = 10**9

    def write(file: Path, **options: Any) -> Path:
        with h5py.File(file, "w") as root:
            for column in COLUMNS:
                root.create_dataset(column, (rows,), dtype="f8", **options)
        return file

    assert write(tmp_path / "a.h5").stat().st_size < 10_000
    for number, options in enumerate(({}, {"chunks": (1000,)}, {"chunks": (10**8,)})):
        message = failure(write(tmp_path / f"{number}.h5", **options))
        assert "more than" in message


# Parquet


def test_a_flipped_bit_of_a_footer_is_an_error(tmp_path: Path) -> None:
    """pyarrow aborts the process when it is asked for a column of some of these files."""
    file = tmp_path / "log.parquet"
    pq.write_table(pa.table({column: values(column) for column in COLUMNS}), file)
    content = file.read_bytes()
    repetition = content.index(b"schema") + 11  # of the first column, two bytes before its name
    refusals = []
    for place in range(8 * repetition, 8 * repetition + 16):
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << place % 8
        file.write_bytes(damaged)
        refusals.append(failure(file))
    assert all("Is it complete?" in text or "no column" in text for text in refusals)


def test_columns_that_unfold_to_many_bytes_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "FREE_BYTES", 10**7)
    file = tmp_path / "log.parquet"
    text = pa.array(["x" * 10**6] * 11)
    numbers = {column: np.arange(11) / 100 for column in COLUMNS}
    pq.write_table(
        pa.table({**numbers, "text": text}), file, compression="zstd", use_dictionary=False
    )
    assert file.stat().st_size < 10**7 / source.BYTES_PER_BYTE
    assert "it decompresses to more than" in failure(file)


# MDF

MDF_MAPPING = a_mapping(time=OWN_CLOCK)


def mdf(file: Path, version: str = "4.10", outside: Path | None = None) -> Path:
    with MDF(version=version) as log:
        for column in COLUMNS[1:]:
            log.append([Signal(values(column), values("t"), name=column)])
        if outside is not None:
            attached = (b"", outside, b"")
            log.append([Signal(values("t"), values("t"), name="video", attachment=attached)])
            attachments: Any = log._mdf
            attachments.attachments[0].flags = 0  # its content is not in the file
            attachments.attachments[0].file_name = str(outside)
        return Path(log.save(file, overwrite=True))


@pytest.mark.usefixtures("in_process")
def test_an_attachment_of_a_channel_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "secret"
    other.write_text(str(SECRET))
    file = mdf(tmp_path / "log.mf4", outside=other)
    read, seen = Path.read_bytes, []

    def noted(path: Path) -> bytes:
        seen.append(path.name)
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", noted)
    with MDF(file) as log:
        assert log.get("video").attachment[0] == str(SECRET).encode()
    assert seen == ["secret"]
    mapping = a_mapping(time=OWN_CLOCK, signals={"ax": {"column": "video", "unit": "m/s^2"}})
    assert read_measured(file, mapping).counts.ticks == ROWS
    assert seen == ["secret"]


def test_links_in_a_circle_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "FREE_S", 0.5)
    monkeypatch.setattr(source, "FREE_MEMORY", 2**27)
    file = mdf(tmp_path / "log")
    data = bytearray(file.read_bytes())
    at = data.index(b"##DG", 64)
    data[at + 24 : at + 32] = at.to_bytes(8, "little")  # the next one is itself
    file.write_bytes(data)
    message = failure(file, MDF_MAPPING)
    assert "took more than" in message or "more than" in message


def conversion(parts: list[int]) -> bytes:
    """A block that gives each value the text, or the conversion, that a link leads to."""
    links = [0, 0, 0, 0, *parts]
    sizes = (len(parts), len(parts) - 1)
    body = struct.pack("<BBHHHdd", 7, 0, 0, *sizes, 0, 0) + bytes(8 * sizes[1])
    head = struct.pack("<4sIQQ", b"##CC", 0, 24 + 8 * len(links) + len(body), len(links))
    return head + struct.pack(f"<{len(links)}Q", *links) + body


@pytest.mark.parametrize("is_circle", [False, True])
def test_conversions_of_conversions_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_circle: bool
) -> None:
    monkeypatch.setattr(source, "FREE_S", 0.5)
    monkeypatch.setattr(source, "FREE_MEMORY", 2**27)
    file = mdf(tmp_path / "log")
    data = bytearray(file.read_bytes())
    data += bytes(-len(data) % 8)
    last = 0
    for _ in range(1 if is_circle else 40):
        at = len(data)
        data += conversion([at if is_circle else last] * 3)
        last = at
    link = data.rindex(b"##CN") + 24 + 4 * 8
    data[link : link + 8] = last.to_bytes(8, "little")
    file.write_bytes(data)
    assert failure(file, MDF_MAPPING)


# CAN


def trace(folder: Path, name: str, content: bytes) -> str:
    file = folder / name
    file.write_bytes(content)
    return failure(file, FORMATS["blf"].mapping)


def blf(content: bytes, packed: bytes | None = None) -> bytes:
    """A BLF file with one container that has these objects."""
    sound = sound_file("blf")
    packed = zlib.compress(content) if packed is None else packed
    header = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(packed), 10)
    container = header + struct.pack("<H6xI4x", 2, len(content)) + packed
    head = bytearray(sound[: int.from_bytes(sound[4:8], "little")])
    head[16:24] = (len(head) + len(container)).to_bytes(8, "little")
    return bytes(head) + container


@pytest.mark.parametrize(
    ("size", "message"),
    [
        (0, "decoding it took more than 1 s"),
        (15, "cannot be read: Could not find next object"),
        (2**32 - 1, "an object in it is damaged, or ends too early"),
    ],
)
def test_an_object_of_a_trace_has_a_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int, message: str
) -> None:
    monkeypatch.setattr(source, "FREE_S", 1.0)
    object_bytes = struct.pack("<4sHHII", b"LOBJ", 32, 1, size, 99) + bytes(64)
    assert re.search(message, trace(tmp_path, "log.blf", blf(object_bytes)))


def test_a_container_that_was_cut_is_no_shorter_trace(tmp_path: Path) -> None:
    sound = sound_file("blf")
    content = zlib.decompress(sound[int.from_bytes(sound[4:8], "little") + 32 :])
    packed = zlib.compress(content)
    file = tmp_path / "log.blf"
    file.write_bytes(blf(content))
    assert read_measured(file, FORMATS["blf"].mapping).counts.rows_kept
    assert "ends too early" in trace(tmp_path, "log.blf", blf(content, packed[: len(packed) // 2]))
    head = int.from_bytes(sound[4:8], "little") + 16
    unknown = blf(content)[:head] + b"\7" + blf(content)[head + 1 :]
    assert "Unknown compression method (7)" in trace(tmp_path, "log.blf", unknown)


def test_the_decoded_size_of_a_trace_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "FREE_MEMORY", 2**26)
    assert "needs more than" in trace(tmp_path, "log.blf", blf(bytes(2**27)))


@pytest.mark.parametrize("name", ["log.asc.gz", "log.db", "log.mf4"])
def test_only_known_traces_are_read(tmp_path: Path, name: str) -> None:
    assert "unknown suffix. CAN traces end with" in trace(tmp_path, name, b"\x1f\x8b" + bytes(9))


@pytest.mark.parametrize(
    "signal",
    [
        ' SG_ ax : 0|2000000000@1- (0.001,0) [0|0] "" ECU',
        ' SG_ ax : 0|65@1- (0.001,0) [0|0] "" ECU',
        ' SG_ ax : 2000000000|16@1- (0.001,0) [0|0] "" ECU',
    ],
)
def test_a_database_cannot_ask_for_more_than_a_frame_has(tmp_path: Path, signal: str) -> None:
    text = "\n".join(signal if " ax " in line else line for line in DBC.splitlines()) + "\n"
    file = tmp_path / "log.blf"
    file.write_bytes(sound_file("blf"))
    bus = CanBus(database="car.dbc", text=text)
    assert failure(file, FORMATS["blf"].mapping.model_copy(update={"can": bus}))
