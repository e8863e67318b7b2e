"""Pieces of one drive share a fold, however its log was cut."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalog.signals import LONGEST_PAUSE_S
from fleet_slip.grams.cohort import EACH, load_cohort
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.resources import read_sql
from tests.support.measured import SIGNALS, a_mapping, csv_text

BEGAN = datetime(2024, 5, 31, 8, tzinfo=UTC)

Drive = tuple[str, str, str | None, int | None, int]
"""Name, car, trip within its file, when it began and how long it lasted, in s."""


@st.composite
def drives(draw: st.DrawFn) -> list[Drive]:
    """Draw drives of two cars; some are dated, some pieces of one file."""
    drawn: list[Drive] = []
    for number in range(draw(st.integers(1, 9))):
        car = draw(st.sampled_from("ab"))
        dated = draw(st.booleans())
        start_s = draw(st.integers(0, 6000)) if dated else None
        earlier = [drive for drive in drawn if drive[1] == car and (drive[3] is not None) == dated]
        named = [None if dated else f"d{number}", *(drive[2] or drive[0] for drive in earlier)]
        drawn.append((f"d{number}", car, draw(st.sampled_from(named)), start_s, 100))
    return drawn


def trips_of(drives: list[Drive]) -> dict[str, str]:
    """Return the trip of each drive, by SQL."""
    at = [None if drive[3] is None else BEGAN + timedelta(seconds=drive[3]) for drive in drives]
    grams = pa.table(
        {
            "feature_set": ["x"] * len(drives),
            "drive_id": [drive[0] for drive in drives],
            "vehicle_id": [drive[1] for drive in drives],
            "trip_id": pa.array([drive[2] for drive in drives], pa.string()),
            "started_at": pa.array(at, pa.timestamp("us", tz="UTC")),
            "duration_s": [float(drive[4]) for drive in drives],
        }
    )
    statement = read_sql("jobs", "trips.sql").format(
        feature_set="x", longest_pause_s=LONGEST_PAUSE_S
    )
    with duckdb.connect() as database:
        database.register("grams", grams)
        return dict(database.sql(statement).fetchall())


def joined(drives: list[Drive]) -> set[frozenset[str]]:
    """Return the trips by joining any two drives that belong together, until none is left."""
    groups = [{drive[0]} for drive in drives]
    for i, a in enumerate(drives):
        for b in drives[:i]:
            same_file = (a[2] or a[0]) == (b[2] or b[0])
            is_near = None not in (a[3], b[3]) and abs(a[3] - b[3]) <= LONGEST_PAUSE_S + 100  # type: ignore[operator]
            if a[1] == b[1] and (same_file or is_near):
                first = next(group for group in groups if a[0] in group)
                other = next(group for group in groups if b[0] in group)
                if first is not other:
                    first |= other
                    groups.remove(other)
    return {frozenset(group) for group in groups}


@given(drives())
def test_drives_that_follow_each_other_are_one_trip(drawn: list[Drive]) -> None:
    trips = trips_of(drawn)
    trip_of_drive = {drive[0]: trips.get(drive[0], drive[0]) for drive in drawn}
    groups = {
        frozenset(d for d in trip_of_drive if trip_of_drive[d] == trip)
        for trip in trip_of_drive.values()
    }
    assert groups == joined(drawn)


def test_a_pause_of_ten_minutes_does_not_part_a_trip_and_a_longer_one_does() -> None:
    first: Drive = ("a", "car", None, 0, 100)
    assert set(trips_of([first, ("b", "car", None, 700, 100)]).values()) == {"a"}
    assert set(trips_of([first, ("b", "car", None, 701, 100)]).values()) == {"a", "b"}
    assert set(trips_of([first, ("b", "other", None, 100, 100)]).values()) == {"a", "b"}


def mapping(day: str | None = None, **time: Any) -> Mapping:
    signals = {**SIGNALS, "ay": {"column": "ay", "unit": "m/s^2"}}
    return a_mapping(time={"unit": None, **time}, drive={"day": day}, signals=signals)


def log_of(rng: np.random.Generator, start: datetime, rows: int = 400) -> dict[str, list[str]]:
    """Signals that say something of the label, from a moment on."""
    ax, ay = rng.normal(0, 2, (2, rows))
    beta = 0.8 * ay - 0.3 * ax + rng.normal(0, 0.2, rows)
    times = [start + timedelta(milliseconds=10 * i) for i in range(rows)]
    return {
        "t": [time.strftime("%Y-%m-%d %H:%M:%S.%f") for time in times],
        "ax": [f"{x:.3f}" for x in ax],
        "ay": [f"{x:.3f}" for x in ay],
        "beta": [f"{x:.3f}" for x in beta],
    }


def write(folder: Path, name: str, log: dict[str, list[str]], rows: slice) -> Path:
    file = folder / name
    file.write_text(csv_text({key: values[rows] for key, values in log.items()}))
    return file


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Fleet, Fleet]:
    """The same five drives of a car, as logs of their own and cut into pieces of a second."""
    folder = tmp_path_factory.mktemp("trips")
    rng = np.random.default_rng(3)
    files: tuple[list[Path], list[Path]] = ([], [])
    for drive in range(5):
        log = log_of(rng, BEGAN + timedelta(hours=drive))
        files[0].append(write(folder, f"whole-{drive}.csv", log, slice(None)))
        for first in range(0, 400, 100):
            rows = slice(first, first + 100)
            files[1].append(write(folder, f"piece-{drive}-{first}.csv", log, rows))
    fleets = []
    for name, parts in zip(("whole", "cut"), files, strict=True):
        fleet = fleet_slip.open(folder / name)
        fleet.ingest(parts, mapping(format="%Y-%m-%d %H:%M:%S%.f"))
        fleet.gram()
        fleets.append(fleet)
    return fleets[0], fleets[1]


def test_a_log_that_was_cut_gives_the_folds_of_the_whole(roots: tuple[Fleet, Fleet]) -> None:
    uncut, cut = (load_cohort(fleet.warehouse) for fleet in roots)
    assert (uncut.drive_count, cut.drive_count) == (5, 20)
    folds = [
        cohort.folds("drive", EACH).complete_cases(["ax", "ay"], "sideslip")
        for cohort in (uncut, cut)
    ]
    assert len(folds[1].names) == 5
    sums = [sorted((gram.n, gram.products) for gram in training.grams) for training in folds]
    assert sums[0] == sums[1]


def test_pieces_of_one_undated_file_are_one_trip(tmp_path: Path) -> None:
    """A gap of two seconds parts drives, and one of eleven minutes parts trips."""
    time = [*np.arange(0, 1, 0.01), *np.arange(3, 4, 0.01), *np.arange(700, 701, 0.01)]
    log = {"t": [f"{t:.2f}" for t in time], **{n: ["1"] * 300 for n in ("ax", "ay", "beta")}}
    fleet = fleet_slip.open(tmp_path / "data")
    file = write(tmp_path, "log.csv", log, slice(None))
    fleet.ingest(file, mapping("2024-05-31", unit="s"))
    rows = fleet.sql(
        "SELECT drive_id, trip_id, drive_name, source_file, started_at, rows FROM drives "
        "ORDER BY drive_id"
    ).fetchall()
    first, second, third = (row[0] for row in rows)
    assert [row[1] for row in rows] == [first, first, third]
    assert {row[2:] for row in rows} == {("log", "log.csv", None, 100)}
    fleet.gram()
    trips = load_cohort(fleet.warehouse).drives.select(["drive_id", "trip"]).to_pylist()
    assert {piece["drive_id"]: piece["trip"] for piece in trips} == {
        first: first,
        second: first,
        third: third,
    }
