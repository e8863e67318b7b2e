"""CAN traces: written by python-can, with databases and payloads by cantools."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from asammdf import MDF, Signal
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.errors import ConfigError, InputError
from fleet_slip.ingest.formats.can import open_can_trace, physical, raw_numbers
from fleet_slip.ingest.formats.file_formats import CanBus, FileFormats, read_can_database
from fleet_slip.ingest.formats.source import Budget
from fleet_slip.ingest.mapping import load_mapping
from tests.support.can_files import Frame, asc_line, write_asc, write_blf
from tests.support.catalog import CATALOG
from tests.support.logs import without_names
from tests.support.measured import MeasuredLog, read_measured, ticks
from tests.support.reported import call

START_S = datetime(2024, 5, 31, 12, tzinfo=UTC).timestamp()
TIME_S = np.arange(50) / 100
AX = np.round(2 * np.sin(5 * TIME_S), 3)
BETA_DEG = np.round(np.cos(3 * TIME_S), 2)
AX_COUNTS = np.rint(AX / 0.001).astype(int).tolist()
BETA_COUNTS = np.rint(np.radians(BETA_DEG) / 0.0001).astype(int).tolist()

DBC = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 256 Motion: 8 ECU
 SG_ ax : 7|16@0- (0.001,0) [0|0] "m/s2" ECU
 SG_ beta : 20|12@1- (0.01,0) [0|0] "deg" ECU
 SG_ state : 40|8@1+ (1,0) [0|0] "" ECU
BO_ 2566844672 Mux: 8 ECU
 SG_ page M : 0|8@1+ (1,0) [0|0] "" ECU
 SG_ yaw m0 : 8|16@1- (0.01,0) [0|0] "deg/s" ECU
 SG_ ay m1 : 8|16@0- (0.01,-1) [0|0] "m/s2" ECU
VAL_ 256 state 0 "off" 1 "on" ;
VAL_ 256 beta 2047 "SNA" ;
"""
DATABASE: Any = cantools.database.load_string(DBC, "dbc")

MAPPING = """name = "bus"
[time]
own_clock = true
[can]
database = "car.dbc"
[drive]
vehicle_id = "A7"
vehicle_model = "sedan"
[signals]
ax = { column = "Motion.ax", unit = "m/s^2" }
sideslip = { column = "Motion.beta", unit = "deg" }
"""


def motion(i: int, bus: Any = 1, **changes: Any) -> can.Message:
    values = {"ax": AX[i], "beta": BETA_DEG[i], "state": "on", **changes}
    data = DATABASE.encode_message("Motion", values, strict=False)
    return can.Message(
        START_S + TIME_S[i], arbitration_id=256, is_extended_id=False, data=data, channel=bus
    )


def mux(i: int, page: int, value: float) -> can.Message:
    message = DATABASE.get_message_by_name("Mux")
    data = message.encode({"page": page, "yaw" if page == 0 else "ay": value})
    return can.Message(START_S + TIME_S[i], arbitration_id=message.frame_id, data=data, channel=1)


def write_trace(folder: Path, frames: list[can.Message], name: str = "log.blf") -> Path:
    with can.Logger(folder / name) as trace:
        for frame in frames:
            trace(frame)
    return folder / name


def read(
    file: Path, text: str = MAPPING, database: str = DBC, name: str = "car.dbc"
) -> MeasuredLog:
    (file.parent / name).write_text(database)
    (file.parent / "bus.toml").write_text(text)
    return read_measured(file, load_mapping(str(file.parent / "bus.toml"), CATALOG))


def failure(file: Path, *arguments: str) -> str:
    with pytest.raises(InputError) as caught:
        read(file, *arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", ["log.blf", "log.asc", "log.log"])
def test_a_trace(tmp_path: Path, name: str) -> None:
    noise = can.Message(START_S, arbitration_id=1792, is_extended_id=False, data=b"\1", channel=1)
    error = can.Message(START_S + 0.001, is_error_frame=True, channel=1)
    file = write_trace(tmp_path, [noise, *map(motion, range(50)), error], name)
    dated = MAPPING.replace("[drive]", "[drive]\nday = 2024-05-31")
    log = read(file, dated if name == "log.asc" else MAPPING)
    assert ticks(log) == list(range(50))
    assert log.drives["ax"].to_pylist() == AX_COUNTS
    assert log.drives["sideslip"].to_pylist() == BETA_COUNTS
    assert str(log.drives["day"][0]) == "2024-05-31"
    if name == "log.asc":
        assert "its clock has no date" in failure(file)


def test_a_kcd_database_says_the_same(tmp_path: Path) -> None:
    file = write_trace(tmp_path, [motion(i) for i in range(50)])
    expected = without_names(read(file).drives)
    text = MAPPING.replace("car.dbc", "car.kcd")
    log = read(file, text, DATABASE.as_kcd_string(), "car.kcd")
    assert without_names(log.drives).equals(expected)


def test_multiplexed_signals_have_the_values_of_their_own_frames(tmp_path: Path) -> None:
    frames = [mux(i, i % 2, i / 10) for i in range(50)]
    text = MAPPING.partition("ax =")[0] + (
        'yaw_rate = { column = "Mux.yaw", unit = "deg/s", interpolate = false }\n'
        'ay = { column = "Mux.ay", unit = "m/s^2", interpolate = false }\n'
    )
    log = read(write_trace(tmp_path, frames), text)
    yaw = np.radians(np.arange(0, 50, 2) / 10) / 0.0001
    assert log.drives["yaw_rate"].to_pylist()[::2] == np.rint(yaw).tolist()
    assert log.drives["yaw_rate"].null_count == 25
    assert log.drives["ay"].to_pylist()[1::2] == [100 * i for i in range(1, 50, 2)]


def test_a_value_with_a_name_is_no_number(tmp_path: Path) -> None:
    frames = [motion(i, **({"beta": "SNA"} if i % 5 == 0 else {})) for i in range(50)]
    for frame in frames[::5]:
        assert DATABASE.decode_message(256, frame.data)["beta"] == "SNA"
    log = read(write_trace(tmp_path, frames))
    expected = [None if i % 5 == 0 else BETA_COUNTS[i] for i in range(50)]
    assert log.drives["sideslip"].to_pylist() == expected


def test_a_message_on_two_buses_must_be_told_apart(tmp_path: Path) -> None:
    frames = [frame for i in range(50) for frame in (motion(i, 1), motion(i, 2, ax=0.0))]
    file = write_trace(tmp_path, frames)
    assert "Motion is on the buses 2, 3. Choose one in the mapping" in failure(file)
    log = read(file, MAPPING.replace('"car.dbc"', '"car.dbc"\nchannel = "2"'))
    assert log.drives["ax"].to_pylist() == AX_COUNTS
    text = MAPPING.replace('"car.dbc"', '"car.dbc"\nchannel = "9"')
    assert "not on the bus 9, but on the buses 2, 3" in failure(file, text)


def test_a_database_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    file = write_trace(tmp_path, [motion(i) for i in range(50)])
    other = DBC.replace("BO_ 256 ", "BO_ 257 ").replace("VAL_ 256", "VAL_ 257")
    message = failure(file, MAPPING, other)
    assert "no message Motion (0x101). Of the 1 identifiers in the trace, 0" in message
    renamed = failure(file, MAPPING.replace("Motion.beta", "Motion.Beta"))
    assert "no column 'Motion.Beta'. Did the mapping mean 'Motion.beta'" in renamed
    short = [
        can.Message(START_S, arbitration_id=256, is_extended_id=False, data=b"\0\0", channel=1)
    ]
    assert "ends in byte 4, the longest has 2" in failure(write_trace(tmp_path, short))
    assert "cantools cannot read it" in failure(file, MAPPING, "no DBC\0")


def test_a_trace_without_a_database_is_refused(tmp_path: Path) -> None:
    file = write_trace(tmp_path, [motion(0)])
    without = MAPPING.replace('[can]\ndatabase = "car.dbc"\n', "")
    assert 'this format needs [can] with database = "….dbc"' in failure(file, without)
    with pytest.raises(ConfigError, match=r"absent\.dbc: no such file"):
        read(file, MAPPING.replace("car.dbc", "absent.dbc"))
    with pytest.raises(ConfigError, match=r"not a CAN database \(\.dbc"):
        read(file, MAPPING.replace("car.dbc", "car.xls"))


def test_a_draft_has_the_signals_and_units_of_the_database(tmp_path: Path) -> None:
    file = write_trace(tmp_path, [motion(i) for i in range(50)])
    named = DBC.replace(" ax ", " AccelLong ").replace(" beta ", " SlipAngle ")
    (tmp_path / "car.dbc").write_text(named)
    words = ("mapping", "suggest", str(file), "--can", str(tmp_path / "car.dbc"))
    draft = call(tmp_path, *words)
    assert 'ax = { column = "Motion.AccelLong", unit = "m/s^2" }' in draft
    assert 'sideslip = { column = "Motion.SlipAngle", unit = "deg" }' in draft


def test_the_content_of_the_database_counts_and_its_path_does_not(tmp_path: Path) -> None:
    file = write_trace(tmp_path, [motion(i) for i in range(50)])
    digest = read(file).digest
    assert read(file, MAPPING.replace("car.dbc", "b.dbc"), DBC, "b.dbc").digest == digest
    assert read(file, MAPPING, DBC.replace("0.001", "0.002")).digest != digest


def test_broken_traces_are_refused(tmp_path: Path) -> None:
    for name in ("log.asc", "log.log"):
        (tmp_path / name).write_bytes(b"")
        assert "it has no CAN frames" in failure(tmp_path / name)
    (tmp_path / "log.log").write_bytes(b"garbage\n")
    assert "Is it complete" in failure(tmp_path / "log.log")


@st.composite
def layouts(draw: st.DrawFn) -> tuple[str, int, int, bool]:
    length = draw(st.integers(1, 64))
    first = draw(st.integers(0, 64 - length))
    if draw(st.booleans()):
        return "little_endian", first, length, draw(st.booleans())
    return "big_endian", 8 * (first // 8) + 7 - first % 8, length, draw(st.booleans())


@given(layouts(), st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=5))
def test_signals_are_decoded_as_cantools_does(
    layout: tuple[str, int, int, bool], payloads: list[bytes]
) -> None:
    order, start, length, signed = layout
    sign, byte_order = ("-" if signed else "+"), (1 if order == "little_endian" else 0)
    text = (
        'VERSION ""\nNS_ :\nBS_:\nBU_: E\nBO_ 1 M: 8 E\n'
        f' SG_ s : {start}|{length}@{byte_order}{sign} (0.5,-3) [0|0] "" E\n'
    )
    database: Any = cantools.database.load_string(text, "dbc")
    (signal,) = database.messages[0].signals
    matrix = np.frombuffer(b"".join(payloads), dtype=np.uint8).reshape(-1, 8)
    raw = raw_numbers(signal, matrix)
    expected = [database.decode_message(1, data, scaling=False)["s"] for data in payloads]
    assert raw.tolist() == expected
    scaled = [database.decode_message(1, data)["s"] for data in payloads]
    np.testing.assert_allclose(physical(signal, raw), scaled, rtol=1e-15)


@pytest.mark.parametrize("compression", [0, 1])
def test_bus_logging_in_mdf(tmp_path: Path, compression: int) -> None:
    frames = [motion(i) for i in range(50)]
    frames += [mux(i, i % 2, i / 100) for i in range(50)]
    frames.sort(key=lambda frame: frame.timestamp)
    with can.MF4Writer(tmp_path / "log.mf4", compression_level=compression) as trace:
        for frame in frames:
            trace.on_message_received(frame)
    mux_signals = 'yaw_rate = { column = "Mux.yaw", unit = "deg/s" }\n'
    log = read(tmp_path / "log.mf4", MAPPING + mux_signals)
    assert ticks(log) == list(range(50))
    assert log.drives["ax"].to_pylist() == AX_COUNTS
    assert log.drives["sideslip"].to_pylist() == BETA_COUNTS
    assert str(log.drives["day"][0]) == "2024-05-31"
    assert log.drives["yaw_rate"].drop_null().to_pylist()[:3] == [0, 2, 3]


def test_bus_logging_says_what_is_not_in_it(tmp_path: Path) -> None:
    with MDF(version="4.10") as mdf:
        mdf.append([Signal(AX, TIME_S, name="ax")])
        file = Path(mdf.save(tmp_path / "log.mf4"))
    with pytest.raises(InputError, match=r"log\.mf4: it has no CAN frames .* without \[can\]"):
        read(file)
    with can.MF4Writer(tmp_path / "bus.mf4") as trace:
        trace.on_message_received(mux(0, 0, 1.0))
    assert "no message Motion (0x100)" in failure(tmp_path / "bus.mf4")


def test_a_trace_is_asked_for_one_message_after_the_other(tmp_path: Path) -> None:
    frames = [motion(i) for i in range(50)] + [mux(i, 0, 1.0) for i in range(50)]
    (tmp_path / "car.dbc").write_text(DBC)
    bus = read_can_database(CanBus(database="car.dbc"), tmp_path)
    budget = Budget.for_file(write_trace(tmp_path, frames))
    with open_can_trace(budget, FileFormats(can=bus)) as source:
        for column in ("Motion.ax", "Mux.yaw", "Motion.beta"):
            (table,) = source.batches([column])
            assert (table.height, table[column].null_count()) == (50, 0)
        assert {channel.base for channel in source.channels()} == {"Motion", "Mux"}


def payload(ax: float) -> bytes:
    return bytes(DATABASE.encode_message("Motion", {"ax": ax, "beta": 0.5, "state": "on"}))


def write_two_buses(folder: Path, suffix: str, *, fd: bool = False) -> Path:
    """Write a trace with ax = 1 m/s^2 on bus 1, and -2 m/s^2 on bus 2."""
    pairs = ((i / 100, bus, ax) for i in range(50) for bus, ax in ((1, 1.0), (2, -2.0)))
    frames = [Frame(t + bus * 1e-4, bus, 256, payload(ax), fd) for t, bus, ax in pairs]
    file = folder / f"two{suffix}"
    if suffix == ".asc":
        return write_asc(file, map(asc_line, frames))
    return write_blf(file, frames, datetime(2024, 5, 31, 12, tzinfo=UTC))


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("suffix", [".asc", ".blf"])
def test_buses_have_the_numbers_of_the_trace(tmp_path: Path, suffix: str, fd: bool) -> None:
    file = write_two_buses(tmp_path, suffix, fd=fd)
    dated = MAPPING.replace("[drive]", "[drive]\nday = 2024-05-31")

    def text(bus: int) -> str:
        return dated.replace('"car.dbc"', f'"car.dbc"\nchannel = "{bus}"')

    for bus, count in ((1, 1000), (2, -2000)):
        assert set(read(file, text(bus)).drives["ax"].to_pylist()) == {count}
    assert "not on the bus 0, but on the buses 1, 2" in failure(file, text(0))
    assert "is on the buses 1, 2" in failure(file, dated)


@pytest.mark.parametrize("is_relative", [False, True])
def test_times_of_asc_begin_before_the_trigger_and_count_every_event(
    tmp_path: Path, is_relative: bool
) -> None:
    times_s = [i / 100 - 0.3 for i in range(50)]
    lines, before_s = [], 0.0
    for i, time_s in enumerate(times_s):
        events = [asc_line(Frame(time_s, 1, 256, payload(i / 10)))]
        events.append(f"{time_s + 0.004:11.6f} 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%")
        events.append(f"{time_s + 0.006:11.6f} 2  ErrorFrame")
        for line in events:
            event_s, text = line.split(maxsplit=1)
            shown_s = float(event_s) - before_s if is_relative else float(event_s)
            lines.append(f"{shown_s:11.6f} {text}")
            before_s = float(event_s)
    file = write_asc(tmp_path / "a.asc", lines, "relative" if is_relative else "absolute")
    log = read(file, MAPPING.replace("[drive]", "[drive]\nday = 2024-05-31"))
    assert ticks(log) == list(range(50))
    assert log.drives["ax"].to_pylist() == [100 * i for i in range(50)]


@pytest.mark.parametrize("suffix", [".asc", ".blf"])
def test_a_trace_starts_in_the_zone_of_the_mapping(tmp_path: Path, suffix: str) -> None:
    file = write_two_buses(tmp_path, suffix)
    text = MAPPING.replace("own_clock = true", 'own_clock = true\nzone = "America/New_York"')
    log = read(file, text.replace('"car.dbc"', '"car.dbc"\nchannel = "1"'))
    started = log.drives["started_at"][0].as_py()
    assert started.astimezone(UTC).replace(microsecond=0) == datetime(2024, 5, 31, 16, tzinfo=UTC)


STATES = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 256 Motion: 8 ECU
 SG_ ax : 7|16@0- (0.001,0) [0|0] "m/s2" ECU
 SG_ beta : 20|12@1- (0.01,0) [0|0] "deg" ECU
BO_ 295 Gear: 8 ECU
 SG_ GEAR : 0|4@1+ (1,0) [0|15] "" ECU
 SG_ level : 8|8@1+ (1,0) [0|255] "" ECU
VAL_ 295 GEAR 5 "P" 6 "R" 7 "N" 8 "D" 14 "Init" 15 "SNA" ;
VAL_ 295 level 254 "Init" 255 "SNA" ;
"""


def write_gears(folder: Path, gears: list[int]) -> Path:
    """Write ax = i mm/s^2 in frame i, and a gear in another message at half the rate."""
    motions = [Frame(1 + i / 100, 1, 256, i.to_bytes(2, "big") + bytes(6)) for i in range(100)]
    states = [
        Frame(0.999 + i / 50, 1, 295, bytes([gear, 2 * i, *bytes(6)]))
        for i, gear in enumerate(gears)
    ]
    frames = sorted([*motions, *states])
    return write_blf(folder / "gears.blf", frames, datetime(2024, 5, 31, 12, tzinfo=UTC))


AX_ALONE = MAPPING.replace('sideslip = { column = "Motion.beta", unit = "deg" }\n', "")


@pytest.mark.parametrize("odd", [None, 3, 15])
def test_a_condition_on_a_state_of_another_message_holds_by_time(
    tmp_path: Path, odd: int | None
) -> None:
    gears = [6] * 20 + [8] * 30
    if odd is not None:
        gears[25] = odd
    text = AX_ALONE.replace("[time]", 'where = [{ column = "Gear.GEAR", one_of = ["D"] }]\n[time]')
    log = read(write_gears(tmp_path, gears), text, STATES)
    # A gear without a name keeps the last one with a name; SNA is a name.
    expected = [i for i in range(40, 100) if odd != 15 or i not in {50, 51}]
    assert log.drives["ax"].to_pylist() == expected
    assert log.counts.quarantined == {}
    assert (log.counts.rows_read, log.counts.rows_left_out) == (100, 100 - len(expected))


@pytest.mark.parametrize("condition", ['one_of = ["8"]', "at_least = 8"])
def test_a_condition_compares_the_number_of_a_state(tmp_path: Path, condition: str) -> None:
    where = f'where = [{{ column = "Gear.GEAR", {condition} }}]\n[time]'
    file = write_gears(tmp_path, [6] * 20 + [8] * 30)
    log = read(file, AX_ALONE.replace("[time]", where), STATES)
    assert log.drives["ax"].to_pylist() == list(range(40, 100))


def test_the_name_of_a_state_precedes_its_number(tmp_path: Path) -> None:
    where = 'where = [{ column = "Gear.GEAR", one_of = ["8"] }]\n[time]'
    file = write_gears(tmp_path, [6] * 20 + [8] * 30)
    log = read(file, AX_ALONE.replace("[time]", where), STATES.replace('6 "R"', '6 "8"'))
    assert log.drives["ax"].to_pylist() == list(range(40))


def test_a_state_as_a_signal_is_its_number(tmp_path: Path) -> None:
    text = AX_ALONE + 'gear = { column = "Gear.GEAR", unit = "1" }\n'
    gears = [6] * 20 + [8] * 20 + [3, 14, 15] + [7] * 7
    log = read(write_gears(tmp_path, gears), text, STATES)
    numbers = log.drives["gear"].to_pylist()
    assert {numbers[i] for i in (1, 30, 41, 79, 99)} == {6, 8, 7}
    assert set(numbers) <= {6, 7, 8, None}


def test_a_condition_on_a_number_of_another_message_holds_by_time(tmp_path: Path) -> None:
    text = AX_ALONE.replace("[time]", 'where = [{ column = "Gear.level", at_least = 60 }]\n[time]')
    log = read(write_gears(tmp_path, [8] * 50), text, STATES)
    assert log.drives["ax"].to_pylist() == list(range(60, 100))
    assert log.counts.quarantined == {}
