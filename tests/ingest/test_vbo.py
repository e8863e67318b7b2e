"""VBO files of Racelogic: their clock, their units, and what may be wrong with them."""

import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet_slip.ingest.formats.file_formats import FileFormats
from fleet_slip.ingest.formats.reading import open_source
from fleet_slip.ingest.mapping import Mapping, load_mapping
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.measured import DRIVE, failure, own_clock, physical, read_measured, reasons
from tests.support.reported import call

HEAD = """File created on 31/05/2024 at {created}

[header]
satellites
time
latitude
longitude
velocity knots
heading
height
Lat accel g
Yaw

[channel units]
deg/s

[comments]
(c) 2001 2003 Racelogic, Prüfstand
Log Rate (Hz) : 100.00

[column names]
sats time lat long velocity heading height Latacc Yaw

[data]
"""
ROWS = 100


def write(
    file: Path, first_s: float = 33_270.0, created: str = "09:14:30", head: str = HEAD
) -> str:
    """Write a second of a drive at 100 Hz; return its text."""
    lines = []
    for i in range(ROWS):
        hours, remainder = divmod((first_s + i / 100) % 86_400, 3600)
        clock = f"{hours:02.0f}{remainder // 60:02.0f}{remainder % 60:05.2f}"
        lines.append(f"137 {clock} +03120.0 +00060.0 040.0 093.5 +0152.6 +{i / 100:.2f} -{i:.1f}")
    text = head.format(created=created) + "\n".join(lines) + "\n"
    file.write_text(text, encoding="utf-8")
    return text


def mapping(**changes: Any) -> Mapping:
    signals = {
        "vehicle_speed": {"column": "velocity", "unit": "knot"},
        "ay": {"column": "Latacc", "unit": "g"},
        "yaw_rate": {"column": "Yaw", "unit": "deg/s"},
    }
    return own_clock(**{"signals": signals, **changes})


def test_columns_have_their_units_and_the_clock_its_date(tmp_path: Path) -> None:
    write(tmp_path / "a.vbo")
    log = read_measured(tmp_path / "a.vbo", mapping())
    assert log.drives["started_at"][0].as_py() == datetime(2024, 5, 31, 9, 14, 30, tzinfo=UTC)
    assert (log.counts.rows_kept, log.counts.drives) == (ROWS, 1)
    np.testing.assert_allclose(
        physical(log, "ay", 0.001)[::33], [0, 3.236, 6.472, 9.709], atol=1e-3
    )
    with open_source(tmp_path / "a.vbo", FileFormats()) as source:
        units = {channel.name: channel.unit for channel in source.channels()}
        (rows,) = source.batches(["sats", "lat", "long"])
    assert units == {
        **{"sats": "", "lat": "deg", "long": "deg", "velocity": "knot", "heading": "deg"},
        **{"height": "m", "Latacc": "g", "Yaw": "deg/s"},
    }
    names = ("sats", "lat", "long")
    assert [rows[name][0] for name in names] == [9.0, 52.0, -1.0]  # 128 is of a correction


@pytest.mark.parametrize(
    ("created", "first", "began"),
    [
        ("23:59:59", "235959.50", datetime(2024, 5, 31, 23, 59, 59, 500_000, tzinfo=UTC)),
        ("00:00:03", "235959.50", datetime(2024, 5, 30, 23, 59, 59, 500_000, tzinfo=UTC)),
        ("23:59:58", "000001.00", datetime(2024, 6, 1, 0, 0, 1, tzinfo=UTC)),
    ],
)
def test_a_drive_goes_on_over_midnight(
    tmp_path: Path, created: str, first: str, began: datetime
) -> None:
    hours, minutes, seconds = int(first[:2]), int(first[2:4]), float(first[4:])
    write(tmp_path / "a.vbo", 3600 * hours + 60 * minutes + seconds, created)
    log = read_measured(tmp_path / "a.vbo", mapping())
    assert (log.counts.rows_kept, log.counts.drives) == (ROWS, 1)
    assert log.drives["started_at"][0].as_py() == began


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        (lambda text: text.replace("\n", "\r\n"), []),
        (lambda text: text.replace("[data]\n", "[DATA] \n"), []),
        (lambda text: text.partition("[data]")[0] + "[data]" + _comma(text), []),
        (lambda text: text.replace("091430.10", " 091430.10"), []),
        (lambda text: text.replace("091430.10", "0914_0.10"), [(11, "missing", "time")]),
        (lambda text: text.replace("091430.10", "091470.10"), [(11, "missing", "time")]),
        (lambda text: text.replace(" 091430.10", ""), [(11, "missing", "time")]),
        (lambda text: text.replace("093.5 +0152.6 +0.10", "+0.10"), [(11, "fewer_fields", None)]),
        (lambda text: text.replace(" 040.0", "\t  040.0").replace("\n137", " \n  137"), []),
        (lambda text: text.replace("Latacc Yaw", " Latacc  Yaw "), []),
        (lambda text: text.replace("+0.10", "+0_10"), [(11, "not_a_number", "ay")]),
        (lambda text: text[:-20], [(100, "cut_line", None)]),
        (lambda text: text[:-90], [(99, "cut_line", None)]),
    ],
)
def test_every_line_is_read_or_refused_for_itself(
    tmp_path: Path, change: Callable[[str], str], refused: list[Any]
) -> None:
    text = write(tmp_path / "a.vbo")
    sound = read_measured(tmp_path / "a.vbo", mapping())
    (tmp_path / "b.vbo").write_bytes(change(text).encode())
    log = read_measured(tmp_path / "b.vbo", mapping())
    assert [(row, reason, signal) for row, reason, signal in reasons(log)] == refused
    lines = [
        tick for tick in range(log.counts.rows_read) if tick + 1 not in {r for r, *_ in refused}
    ]
    for name in ("tick", "ay", "yaw_rate", "vehicle_speed"):
        assert log.drives[name].to_pylist() == [sound.drives[name][i].as_py() for i in lines]


def _comma(text: str) -> str:
    return text.partition("[data]")[2].replace(".", ",")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[data]", "[dat]", "a VBO file without the section [data]"),
        ("[column names]", "", "a VBO file without the section [column names]"),
        ("sats time", "sats clock", "no column 'time'"),
        ("velocity heading", "velocity velocity", "2 columns are called 'velocity'"),
        ("File created on 31/05/2024 at 09:14:30", "", "its clock has no date"),
        ("31/05/2024", "31/06/2024", "its clock has no date"),
    ],
)
def test_missing_parts_of_a_file_are_named(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    text = write(tmp_path / "a.vbo")
    (tmp_path / "a.vbo").write_text(text.replace(old, new))
    assert message in failure(tmp_path / "a.vbo", mapping())
    if "date" in message:
        dated = mapping(drive=DRIVE)
        assert read_measured(tmp_path / "a.vbo", dated).drives["day"][0].as_py() == DRIVE["day"]


def test_the_mapping_of_the_page_is_one(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text("utf-8")
    toml = page.partition("## VBO")[2].partition("```toml")[2].partition("```")[0]
    (tmp_path / "page.toml").write_text(
        f'name = "page"\n{toml}[drive]\nvehicle_id = "A"\nvehicle_model = "m"\n'
    )
    write(tmp_path / "a.vbo", head=HEAD.replace("knots", "kmh").replace(" Yaw\n", " YawRate\n"))
    log = read_measured(tmp_path / "a.vbo", load_mapping(str(tmp_path / "page.toml"), CATALOG))
    assert log.counts.rows_kept == ROWS
    # Values that stay are those of one fix, which stands in its first row.
    assert physical(log, "satellite_speed", 0.005)[0] == pytest.approx(40 / 3.6, abs=0.003)
    course = physical(log, "course", float(SIGNALS["course"].scale))[0]
    assert math.sin(course - math.radians(90 - 93.5)) == pytest.approx(0, abs=2e-4)


def test_rows_may_be_chosen_by_the_time_and_the_satellites(tmp_path: Path) -> None:
    write(tmp_path / "a.vbo")
    log = read_measured(
        tmp_path / "a.vbo",
        mapping(where=[{"column": "time", "above": 91430.5}, {"column": "sats", "below": 10}]),
    )
    assert log.counts.rows_kept == ROWS // 2 - 1


def test_a_draft_takes_speed_and_heading_for_the_receivers(tmp_path: Path) -> None:
    write(tmp_path / "a.vbo")
    draft = call(tmp_path, "mapping", "suggest", str(tmp_path / "a.vbo"))
    for line in (
        "own_clock = true",
        'course = { column = "heading", unit = "deg", clockwise_from_north = true',
        'satellite_speed = { column = "velocity", unit = "knot"',
        'ay = { column = "Latacc", unit = "g"',
    ):
        assert line in draft
    assert "day = " not in draft


def test_names_with_blanks_and_rows_with_fewer_fields_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.vbo"
    text = write(file, head=HEAD.replace("heading height Latacc", "heading height Lateral Acc"))
    assert "10 names in [column names], and 9 fields in the first row" in failure(file, mapping())
    file.write_text(text.replace("Lateral Acc", "Latacc").replace(" +0152.6", ""))
    assert "9 names in [column names], and 8 fields in the first row" in failure(file, mapping())


def test_blanks_after_the_names_move_no_unit(tmp_path: Path) -> None:
    write(tmp_path / "a.vbo", head=HEAD.replace("Latacc Yaw", "Latacc Yaw  "))
    with open_source(tmp_path / "a.vbo", FileFormats()) as source:
        units = {channel.name: channel.unit for channel in source.channels()}
    assert (units["Yaw"], units["Latacc"]) == ("deg/s", "g")


def test_a_line_without_end_is_refused(tmp_path: Path) -> None:
    text = write(tmp_path / "a.vbo")
    for line in ("1" * 2**21, "1 " * 2**22):
        (tmp_path / "a.vbo").write_text(f"{text}{line}\n{text.rpartition('[data]')[2]}")
        assert "a line is longer than 1,048,576 characters" in failure(
            tmp_path / "a.vbo", mapping()
        )


def test_rows_are_the_same_in_pieces_of_any_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = write(tmp_path / "a.vbo").replace("\n", "\r\n") + "\r\n\r\n"
    (tmp_path / "a.vbo").write_bytes(text.encode())
    monkeypatch.setattr("fleet_slip.ingest.formats.vbo._BATCH_CHARACTERS", 100)
    log = read_measured(tmp_path / "a.vbo", mapping())
    assert (log.counts.rows_kept, log.counts.quarantined) == (ROWS, {})
