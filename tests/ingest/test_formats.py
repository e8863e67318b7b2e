"""The same drive in every format, written by other programs, comes out as the same counts."""

import gc
import re
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
import scipy.sparse
from asammdf import MDF, Signal

from fleet_slip.errors import ExtraError, InputError
from fleet_slip.ingest.draft import draft_mapping, write_draft
from fleet_slip.ingest.formats import matlab, mdf
from fleet_slip.ingest.formats import source as budget
from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.source import Budget
from fleet_slip.ingest.logs import preview_logs
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.profile import profile_file
from tests.support.catalog import SIGNALS
from tests.support.format_values import (
    AX,
    AX_COUNTS,
    BETA_COUNTS,
    BETA_DEG,
    START,
    TIME_S,
    require_the_drive,
)
from tests.support.fuzz import logs
from tests.support.fuzz.logs import FORMATS, sound_file
from tests.support.measured import (
    OWN_CLOCK,
    a_mapping,
    failure,
    own_clock,
    physical,
    read_measured,
    ticks,
)


def signals(ax: str, beta: str, **beta_keys: Any) -> dict[str, Any]:
    return {
        "ax": {"column": ax, "unit": "m/s^2"},
        "sideslip": {"column": beta, "unit": "deg", **beta_keys},
    }


def mdf_mapping(**changes: Any) -> Mapping:
    return own_clock(**{"signals": signals("a_x", "beta"), **changes})


def write_mdf(folder: Path, *groups: list[Signal], version: str = "4.10", **save: Any) -> Path:
    with MDF(version=version) as mdf:
        mdf.start_time = START
        for group in groups:
            mdf.append(group)
        return Path(mdf.save(folder / "log", overwrite=True, **save))


def a_x(**changes: Any) -> Signal:
    signal = {"samples": np.rint(AX * 1000).astype("i2"), "timestamps": TIME_S, "name": "a_x"}
    return Signal(**{**signal, "conversion": {"a": 0.001, "b": 0.0}, **changes})


def beta(**changes: Any) -> Signal:
    return Signal(**{"samples": BETA_DEG, "timestamps": TIME_S, "name": "beta", **changes})


def test_groups_of_an_mdf_file_keep_their_own_times(tmp_path: Path) -> None:
    slow = beta(samples=BETA_DEG[::5], timestamps=TIME_S[::5])
    fast_s = np.arange(-3, 10 * 100) / 1000
    fast = Signal(2 * fast_s, fast_s, name="fast", unit="rad/s")
    mapping = mdf_mapping(
        signals={
            **signals("a_x", "beta"),
            "yaw_rate": {"column": "fast", "unit": "rad/s"},
            "vy": {"column": "beta", "unit": "m/s", "interpolate": False},
        }
    )
    log = read_measured(write_mdf(tmp_path, [a_x()], [slow], [fast]), mapping)
    assert log.counts.rows_kept == log.counts.rows_read == 100 + 20 + 1003
    # The first row is 3 ms before the others' first: the ticks begin there.
    at_s = TIME_S[: log.drives.num_rows] - 0.003
    yaw_rate = np.array(log.drives["yaw_rate"].to_pylist(), dtype=float) * 0.0001
    np.testing.assert_allclose(yaw_rate[1:-1], 2 * at_s[1:-1], atol=0.0001)
    sideslip = np.array(log.drives["sideslip"].to_pylist(), dtype=float) * 0.0001
    inside = (at_s >= 0) & (at_s <= 0.95)
    expected = np.interp(at_s[inside], TIME_S[::5], np.radians(BETA_DEG[::5]))
    np.testing.assert_allclose(sideslip[inside], expected, atol=0.00006)
    assert np.isnan(sideslip[~inside]).all()
    placed = log.drives["vy"].drop_null().to_numpy() * 0.005
    np.testing.assert_allclose(placed, BETA_DEG[::5], atol=0.0026)


def test_invalid_samples_of_mdf_are_null(tmp_path: Path) -> None:
    invalid = np.arange(100) % 7 == 0
    file = write_mdf(tmp_path, [a_x(), beta(invalidation_bits=invalid)])
    log = read_measured(file, mdf_mapping())
    assert log.drives["ax"].to_pylist() == AX_COUNTS
    expected = [None if bad else b for b, bad in zip(BETA_COUNTS, invalid, strict=True)]
    assert log.drives["sideslip"].to_pylist() == expected


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("version", ["3.30", "4.10", "4.20"])
def test_a_group_of_an_mdf_file_is_read_window_by_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    flags = {} if version == "3.30" else {"invalidation_bits": np.arange(100) % 7 == 0}
    file = write_mdf(tmp_path, [a_x(), beta(**flags)], version=version)
    expected = read_measured(file, mdf_mapping())
    monkeypatch.setattr(mdf, "WINDOW_RECORDS", 33)
    with mdf.open_mdf(Budget.for_file(file), FileFormats()) as source:
        batches = list(source.batches(["a_x", "beta"]))
    assert [batch.height for batch in batches] == [33, 33, 33, 1]
    log = read_measured(file, mdf_mapping())
    assert log.drives.equals(expected.drives)
    assert log.drives["sideslip"].null_count == (15 if flags else 0)


@pytest.mark.usefixtures("in_process")
def test_a_large_group_of_an_mdf_file_is_not_read_as_a_whole_for_each_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Treat every group as asammdf treats groups from 200 MiB on."""
    file = write_mdf(tmp_path, [a_x(), beta()])
    expected = read_measured(file, mdf_mapping())

    def read_all(*_: Any) -> None:
        raise AssertionError("all records are read")

    monkeypatch.setattr("asammdf.mdf.validate_blocks", lambda *_: True)
    monkeypatch.setattr("asammdf.mdf.get_channel_raw_bytes_complete", read_all)
    assert read_measured(file, mdf_mapping()).drives.equals(expected.drives)


def test_an_unfinalised_mdf_file_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    file = write_mdf(tmp_path, [a_x(), beta()])
    data = bytearray(file.read_bytes())
    data[:8] = b"UnFinMF "
    data[60] = 1  # the cycle counters are not up to date
    file.write_bytes(data)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    require_the_drive(read_measured(file, mdf_mapping()))
    file.write_bytes(data[: len(data) // 3])
    failure(file, mdf_mapping())
    gc.collect()
    assert list(temporary.iterdir()) == []  # no copy of the recording stays behind
    assert capfd.readouterr().err == ""


def test_a_condition_of_one_group_holds_for_the_others(tmp_path: Path) -> None:
    fix = Signal(np.array([4, 4, 0, 4] * 5, dtype="u1"), TIME_S[::5], name="fix")
    mapping = mdf_mapping(where=[{"column": "fix", "at_least": 4}])
    log = read_measured(write_mdf(tmp_path, [a_x(), beta()], [fix]), mapping)
    rows = [i for i in range(100) if (i // 5) % 4 != 2]
    assert ticks(log) == rows
    assert log.drives["ax"].to_pylist() == [AX_COUNTS[i] for i in rows]


def test_a_channel_of_two_groups_must_be_told_apart(tmp_path: Path) -> None:
    file = write_mdf(tmp_path, [a_x(), beta()], [beta(samples=BETA_DEG + 1)])
    message = failure(file, mdf_mapping())
    assert "2 channels are called 'beta'. Choose one: 'beta@0', 'beta@1'" in message
    require_the_drive(read_measured(file, mdf_mapping(signals=signals("a_x", "beta@0"))))


@pytest.mark.parametrize(
    ("block", "offset", "value", "message"),
    [
        (b"##CN", 92, 60_000, "lies outside of the records of its group: the file is damaged"),
        (b"##CG", 80, 10**9, "states 1,000,000,000 samples of 18 bytes"),
        (b"##DZ", 32, 2**60, "cannot be read: "),
    ],
)
def test_a_damaged_mdf_file_does_not_lead_its_reader_astray(
    tmp_path: Path, block: bytes, offset: int, value: int, message: str
) -> None:
    file = write_mdf(tmp_path, [a_x(), beta()], compression=2)
    data = bytearray(file.read_bytes())
    at = data.rindex(block) + offset
    size = 4 if block == b"##CN" else 8
    data[at : at + size] = value.to_bytes(size, "little")
    file.write_bytes(data)
    assert message in failure(file, mdf_mapping())


def test_mdf_errors_name_the_channel_and_the_way_out(tmp_path: Path) -> None:
    text = Signal(np.array([b"on"] * 100), TIME_S, name="text", encoding="utf-8")
    file = write_mdf(tmp_path, [a_x(), beta(), text])
    message = failure(file, mdf_mapping(signals=signals("a_x", "Beta")))
    assert "no column 'Beta'. Did the mapping mean 'beta'?" in message
    message = failure(file, mdf_mapping(signals={"ax": {"column": "text", "unit": "m/s^2"}}))
    assert "100 not_a_number; first: ax = 'on' in row 1" in message
    assert "set own_clock = true under [time]" in failure(file, a_mapping())
    empty = write_mdf(tmp_path, [a_x(samples=np.zeros(0, "i2"), timestamps=np.zeros(0))])
    message = failure(empty, mdf_mapping(signals={"ax": {"column": "a_x", "unit": "m/s^2"}}))
    assert "a header without rows" in message


def test_a_signal_that_reaches_no_tick_is_named(tmp_path: Path) -> None:
    rare = beta(samples=BETA_DEG[3::40], timestamps=TIME_S[3::40] + 0.004)
    file = write_mdf(tmp_path, [a_x()], [rare])
    message = failure(file, mdf_mapping())
    assert "sideslip has 3 values in 'beta', and none is on a tick of 100 Hz" in message
    bridged = mdf_mapping(signals=signals("a_x", "beta", longest_gap_s=0.4))
    assert read_measured(file, bridged).drives["sideslip"].null_count == 100 - 80


def mat_mapping(**changes: Any) -> Mapping:
    keys = {
        "time": {"column": "Data.t"},
        "drive": {"day": START.date()},
        "signals": signals("Data.Vehicle.ax", "Data.beta(:,2)"),
    }
    return a_mapping(**{**keys, **changes})


def write_mat5(file: Path, content: dict[str, Any]) -> None:
    scipy.io.savemat(file, content, do_compression=True)


def write_mat73(file: Path, content: dict[str, Any]) -> None:
    def write(group: Any, values: dict[str, Any]) -> None:
        for name, value in values.items():
            if isinstance(value, dict):
                write(group.create_group(name), value)
            else:  # MATLAB's axes are the other way round, and a vector is a matrix
                group.create_dataset(name, data=np.atleast_2d(value).T if value.ndim > 1 else value)

    with h5py.File(file, "w", userblock_size=512) as root:
        write(root, content)
    with file.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\x02IM")


@pytest.mark.parametrize("write", [write_mat5, write_mat73])
def test_matlab(tmp_path: Path, write: Callable[[Path, dict[str, Any]], None]) -> None:
    file = tmp_path / "log.mat"
    both = np.column_stack([np.zeros(100), BETA_DEG])
    gps = {"t": TIME_S[::2], "beta": BETA_DEG[::2], "text": np.array([[1.0, 2.0]])}
    data = {"t": TIME_S, "Vehicle": {"ax": AX}, "beta": both}
    write(file, {"Data": data, "gps": gps})
    require_the_drive(read_measured(file, mat_mapping()))
    short = mat_mapping(signals=signals("Data.Vehicle.ax", "gps.beta"))
    assert "'gps.beta' has 50 values and 'Data.t' has 100. Give the signal" in failure(file, short)
    mapping = mat_mapping(
        signals=signals("Data.Vehicle.ax", "gps.beta", time="gps.t", interpolate=False)
    )
    log = read_measured(file, mapping)
    assert log.drives["ax"].to_pylist() == AX_COUNTS
    assert log.drives["sideslip"].drop_null().to_pylist() == BETA_COUNTS[::2]
    draft = write_draft(draft_mapping(SIGNALS, file, profile_file(file)), "draft")
    assert 'ax = { column = "Data.Vehicle.ax", ' in draft
    absent = mat_mapping(signals=signals("Data.Vehicle.ay", "gps.beta"))
    assert "Did the mapping mean 'Data.Vehicle.ax'" in failure(file, absent)


def a_table() -> pa.Table:
    return pa.table({"t": TIME_S, "ax": AX, "beta": BETA_DEG})


def test_the_folders_of_a_hive_partitioned_dataset_are_columns(tmp_path: Path) -> None:
    folder = tmp_path / "car=A%207" / "day=2024-05-31"
    folder.mkdir(parents=True)
    pq.write_table(a_table(), folder / "part-0.parquet")
    mapping = a_mapping(drive={"vehicle_id": {"column": "car"}, "day": {"column": "day"}})
    log = read_measured(folder / "part-0.parquet", mapping)
    require_the_drive(log)
    assert log.drives["vehicle_id"].unique().to_pylist() == ["A 7"]
    other = tmp_path / "car=B" / "day=2024-05-31"
    other.mkdir(parents=True)
    pq.write_table(a_table(), other / "part-0.parquet")
    assert read_measured(other / "part-0.parquet", mapping).digest != log.digest


@pytest.mark.parametrize("null", ["vehicle_id", "day"])
def test_a_null_partition_is_no_car_and_no_day(tmp_path: Path, null: str) -> None:
    texts = {"vehicle_id": "A", "day": "2024-05-31", null: "__HIVE_DEFAULT_PARTITION__"}
    folder = tmp_path.joinpath(*(f"{key}={text}" for key, text in texts.items()))
    folder.mkdir(parents=True)
    pq.write_table(a_table(), folder / "part-0.parquet")
    mapping = a_mapping(drive={key: {"column": key} for key in texts})
    refusal = failure(folder / "part-0.parquet", mapping)
    assert "rows is usable" in refusal
    assert f"first: {null} = None in row" in refusal


@pytest.mark.parametrize("magic", [b"PK\x03\x04", b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07"])
def test_an_archive_is_to_be_unpacked(tmp_path: Path, magic: bytes) -> None:
    file = tmp_path / "log.mf4"
    file.write_bytes(magic + b"\0" * 100)
    assert "it is an archive. Unpack it with" in failure(file, mdf_mapping())


@pytest.mark.parametrize(("name", "kind"), [("a.mf4", "an MDF file"), ("a.mat", "a MATLAB file")])
def test_a_file_that_is_not_what_its_name_says_is_refused(
    tmp_path: Path, name: str, kind: str
) -> None:
    (tmp_path / name).write_bytes(b"t,ax,beta\n0,1,2\n")
    assert f"not {kind}" in failure(tmp_path / name, a_mapping())


@pytest.mark.usefixtures("in_process")
def test_a_package_that_is_absent_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write_mdf(tmp_path, [a_x(), beta()])
    monkeypatch.setitem(__import__("sys").modules, "asammdf", None)
    with pytest.raises(ExtraError, match=r"asammdf, which is not installed. Run: pip install .fl"):
        failure(file, mdf_mapping())


def test_a_group_without_samples_is_a_signal_without_values(tmp_path: Path) -> None:
    nothing = beta(samples=np.zeros(0), timestamps=np.zeros(0))
    file = write_mdf(tmp_path, [a_x()], [nothing])
    condition = a_x(samples=np.ones(100, "i2"), name="fix", conversion=None)
    log = read_measured(file, mdf_mapping())
    assert log.drives["ax"].to_pylist() == AX_COUNTS
    assert log.drives["sideslip"].null_count == 100
    (preview,) = preview_logs([file], mdf_mapping())
    (suspicion,) = preview.suspicions
    assert (suspicion.kind, suspicion.signals) == ("absent", ("sideslip",))
    file = write_mdf(tmp_path, [a_x()], [beta()], [nothing_but(condition)])
    where = mdf_mapping(where=[{"column": "fix", "at_least": 1}])
    assert "none of 200 rows meets the condition" in failure(file, where)


def nothing_but(signal: Signal) -> Signal:
    return Signal(signal.samples[:0], signal.timestamps[:0], name=signal.name)


def test_columns_of_matlab_5_are_listed(tmp_path: Path) -> None:
    content = {
        "row": np.ones((1, 8)), "wide": np.ones((9, 3)), "cube": np.ones((2, 3, 4)), "one": 4.0,
        "empty": np.zeros((0, 1)), "words": "words", "names": np.array(["ab", "cde", "fu", "x"]),
        "s": {"deep": {"x": np.arange(10.0).reshape(5, 2)}}, "complex": np.ones(6) + 1j,
        "structs": np.array([(1.0,), (2.0,)], dtype=[("a", "f8")]),
    }  # fmt: skip
    file = tmp_path / "log.mat"
    scipy.io.savemat(file, content)
    with matlab.open_mat(Budget.for_file(file), FileFormats()) as source:
        listed = [channel.name for channel in source.channels()]
        (batch,) = source.batches(["s.deep.x(:,2)"])
        (names,) = source.batches(["names"])
    columns = [f"wide(:,{i})" for i in (1, 2, 3)]
    assert listed == ["row", *columns, "names", "s.deep.x(:,1)", "s.deep.x(:,2)"]
    assert batch["s.deep.x(:,2)"].to_list() == [1.0, 3.0, 5.0, 7.0, 9.0]
    assert [text.strip() for text in names["names"]] == ["ab", "cde", "fu", "x"]


LINES = ("asc", "candump", "vbo")
"""Formats of which what comes before the cut is read, as of CSV."""


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_says_the_same(tmp_path: Path, name: str) -> None:
    file = tmp_path / f"log{FORMATS[name].suffix}"
    file.write_bytes(sound_file(name))
    log = read_measured(file, FORMATS[name].mapping)
    assert ticks(log) == list(range(logs.ROWS))
    np.testing.assert_allclose(physical(log, "ax", 0.001), logs.AX, atol=1e-6)
    sideslip = physical(log, "sideslip", 0.0001)
    finite = np.isfinite(sideslip)
    assert finite.sum() == logs.ROWS - ("mdf4" in name)  # whose first value is marked as invalid
    np.testing.assert_allclose(sideslip[finite], np.radians(logs.BETA)[finite], atol=5.1e-5)


@pytest.mark.parametrize("share", [0.3, 0.7, 0.99])
@pytest.mark.parametrize("name", [name for name in FORMATS if name not in LINES])
def test_a_file_that_was_cut_is_refused(
    tmp_path: Path, name: str, share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"log{FORMATS[name].suffix}"
    content = sound_file(name)
    file.write_bytes(content[: int(share * len(content))])
    message = failure(file, FORMATS[name].mapping)
    assert re.search("Is it complete|ends too early|it is truncated", message)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("reader_zone", ["UTC", "Asia/Tokyo"])
@pytest.mark.parametrize("version", ["3.00", "4.10"])
def test_a_clock_without_a_zone_does_not_depend_on_the_zone_of_the_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, reader_zone: str
) -> None:
    with MDF(version=version) as file:
        file.append([a_x()])
        if version == "3.00":
            file.header.date, file.header.time = b"31:05:2024", b"12:00:00"
        else:
            file.start_time = START.replace(tzinfo=None)
        log = Path(file.save(tmp_path / "log", overwrite=True))
    monkeypatch.setenv("TZ", reader_zone)
    time.tzset()
    try:
        for zone, hour in ((None, 12), ("America/New_York", 16)):
            clock = {**OWN_CLOCK, "zone": zone}
            only_ax = {"ax": {"column": "a_x", "unit": "m/s^2"}}
            drives = read_measured(log, own_clock(time=clock, signals=only_ax)).drives
            started = drives["started_at"][0].as_py().astimezone(UTC)
            assert started == datetime(2024, 5, 31, hour, tzinfo=UTC)
    finally:
        monkeypatch.undo()
        time.tzset()


@pytest.mark.parametrize("default", [None, b"", b"SNA"])
def test_a_state_of_mdf_without_a_name_is_missing(tmp_path: Path, default: bytes | None) -> None:
    names = {"val_0": 5, "text_0": b"R", "val_1": 6, "text_1": b"D", "val_2": 7, "text_2": b"SNA"}
    gears = np.array([5] * 30 + [6] * 30 + [9, 7] + [6] * 38, "u1")
    state = {**names, "default_addr": default} if default is not None else names
    gear = Signal(samples=gears, timestamps=TIME_S, name="gear", conversion=state)
    file = write_mdf(tmp_path, [a_x()], [gear])
    ax = {"ax": {"column": "a_x", "unit": "m/s^2"}}
    where = [{"column": "gear", "one_of": ["D"]}]
    log = read_measured(file, own_clock(signals=ax, where=where))
    assert log.counts.rows_kept in {68, 70} and log.counts.quarantined == {}
    of_number = [{"column": "gear", "one_of": ["6"]}]
    assert read_measured(file, own_clock(signals=ax, where=of_number)).counts.rows_kept in {68, 70}
    both = {**ax, "gear": {"column": "gear", "unit": "1"}}
    assert set(read_measured(file, own_clock(signals=both)).drives["gear"].to_pylist()) <= {
        5, 6, None,
    }  # fmt: skip


def write_structs5(file: Path) -> None:
    fields = [("Name", "O"), ("Data", "O"), ("Unit", "O")]
    structs = np.zeros((1, 2), dtype=fields)
    structs[0, 0] = ("accel x", AX.reshape(1, -1), "m/s2")
    structs[0, 1] = ("beta", BETA_DEG.reshape(1, -1), "deg")
    both = np.stack([AX, BETA_DEG])
    scipy.io.savemat(file, {"rec": {"X": {"Data": TIME_S}, "Y": structs}, "both": both})


def write_structs73(file: Path) -> None:
    with h5py.File(file, "w", userblock_size=512) as root:
        root["rec/X/Data"] = TIME_S
        root["#refs#/a"], root["#refs#/b"] = AX.reshape(-1, 1), BETA_DEG.reshape(-1, 1)
        references = [root["#refs#/a"].ref, root["#refs#/b"].ref]
        root["rec/Y/Data"] = np.array(references, dtype=h5py.ref_dtype).reshape(-1, 1)
        root["both"] = np.stack([AX, BETA_DEG]).T


@pytest.mark.parametrize("write", [write_structs5, write_structs73])
def test_arrays_of_structs_and_rows_of_a_matrix(
    tmp_path: Path, write: Callable[[Path], None]
) -> None:
    file = tmp_path / "log.mat"
    write(file)
    for ax, beta in (("rec.Y(1).Data", "rec.Y(2).Data"), ("both(1,:)", "both(2,:)")):
        time = {"column": "rec.X.Data", "unit": "s"}
        log = read_measured(file, a_mapping(time=time, signals=signals(ax, beta)))
        assert log.drives["ax"].to_pylist() == AX_COUNTS
        assert log.drives["sideslip"].to_pylist() == BETA_COUNTS
    wide = failure(file, a_mapping(time={"column": "rec.X.Data"}, signals=signals("both", "both")))
    assert "no column 'both'. Did the mapping mean 'both(" in wide
    if write is write_structs5:
        guesses = draft_mapping(SIGNALS, file, profile_file(file)).guesses
        assert guesses["ax"].column == "rec.Y(1).Data"
        assert guesses["ax"].keys["unit"] == "m/s^2"


@pytest.mark.parametrize("kind", ["timetable", "table", "timeseries"])
def test_an_object_of_matlab_is_named_with_what_to_do(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "log.mat"
    with h5py.File(file, "w", userblock_size=512) as root:
        dataset = root.create_dataset("TT", data=np.ones((1, 6), "u4"))
        dataset.attrs["MATLAB_class"] = np.bytes_(kind)
        root["n"] = np.ones((1, 1))
    mapping = a_mapping(time={"column": "TT.Time"}, signals=signals("TT.ax", "TT.beta"))
    assert f"is a {kind} of MATLAB" in failure(file, mapping)
    with pytest.raises(InputError, match=f"is a {kind} of MATLAB.* Save it as a struct"):
        draft_mapping(SIGNALS, file, profile_file(file))


@pytest.mark.parametrize("shift_s", [-7200.0, -START.timestamp() + 5.0])
def test_groups_of_two_clocks_are_refused(tmp_path: Path, shift_s: float) -> None:
    late = beta(timestamps=TIME_S + shift_s + START.timestamp())
    first = a_x(timestamps=TIME_S + START.timestamp())
    with MDF(version="4.10") as file:
        file.start_time = datetime(1970, 1, 1, tzinfo=UTC)
        file.append([first])
        file.append([late])
        log = Path(file.save(tmp_path / "log", overwrite=True))
    message = failure(log, mdf_mapping())
    assert "its signals have no time in common: 'a_x' begins at 1,717" in message


@pytest.mark.parametrize(("offset", "value"), [(176, 0), (176, 15), (180, 2**31), (128, 99)])
def test_a_damaged_matlab_file_does_not_bring_its_reader_down(
    tmp_path: Path, offset: int, value: int
) -> None:
    file = tmp_path / "log.mat"
    scipy.io.savemat(file, {"t": TIME_S, "Data": {"beta": BETA_DEG}})
    data = bytearray(file.read_bytes())
    data[offset : offset + 4] = value.to_bytes(4, "little")
    file.write_bytes(data)
    assert str(file) in failure(file, mat_mapping())


def test_a_matlab_5_bomb_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "FREE_MEMORY", 2**26)
    file = tmp_path / "log.mat"
    scipy.io.savemat(file, {"t": np.zeros(2**24)}, do_compression=True)
    assert "needs more than" in failure(file, mat_mapping())
