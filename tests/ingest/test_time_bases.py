"""Several time bases come together window by window as all at once, and are resampled."""

import math
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from operator import itemgetter
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import InputError
from fleet_slip.ingest import batches, drives
from fleet_slip.ingest.batches import DISORDER, HELD, ROW, merge_bases
from fleet_slip.ingest.formats.source import BASE, OWN_TIME, Channel, Source
from fleet_slip.ingest.ticks import average, choose_grid, interpolate
from tests.support.measured import OWN_CLOCK, MeasuredLog, a_mapping, own_clock, read_measured

GAP_S = 1.0


class FakeSource(Source):
    """A file with clocks that is in memory, read in batches of some rows."""

    has_clock = True

    def __init__(self, frames: Sequence[pl.DataFrame], batch: int) -> None:
        self._frames, self._batch = frames, batch

    def channels(self) -> list[Channel]:
        return [Channel(name) for frame in self._frames for name in frame.columns[1:]]

    def bases(self, columns: Sequence[str]) -> list[Iterator[pl.DataFrame]]:
        frames = (frame for frame in self._frames if {*columns} & {*frame.columns})
        return [self._read(frame, columns) for frame in frames]

    def _read(self, frame: pl.DataFrame, columns: Sequence[str]) -> Iterator[pl.DataFrame]:
        selected = frame.select(OWN_TIME, *(name for name in columns if name in frame.columns))
        if not selected.height:
            yield selected
        yield from selected.iter_slices(self._batch)


def reason_and_place(times: Sequence[float]) -> list[tuple[str | None, float]]:
    """Return the fault of each time of a base, and the last valid time, one by one."""
    result: list[tuple[str | None, float]] = []
    right = -math.inf
    for i, time in enumerate(times):
        inside = 0 < i < len(times) - 1
        reason = "time_duplicate" if time == right else "time_backwards" if time < right else None
        if inside and time - times[i - 1] > GAP_S and times[i + 1] < time:
            reason = "isolated"
        elif math.isfinite(time):
            right = max(right, time)
        result.append((reason, right))
    return result


def merged(bases: Sequence[Sequence[tuple[float, float | None]]]) -> list[tuple[Any, ...]]:
    """All rows as (place, base, row, time, value, reason, held): the value of base 0 is held."""
    rows, faults = [], []
    for base, samples in enumerate(bases):
        judged = reason_and_place([time for time, _ in samples])
        pairs = zip(samples, judged, strict=True)
        for number, ((time, value), (reason, place)) in enumerate(pairs, 1):
            rows.append((place, base, number, time, value, reason))
            if base == 0 and reason is None and value is not None and math.isfinite(time):
                faults.append((time, value))
    rows.sort(key=lambda row: row[0])
    result = []
    for row in rows:
        before = [(time, value) for time, value in faults if time <= row[0]]
        held = before[-1][1] if before and row[0] - before[-1][0] <= GAP_S else None
        result.append((*row, held))
    return result


times = st.integers(0, 60).map(lambda tenths: tenths / 10)
moments = st.one_of(times, times, times, st.sampled_from([math.nan, math.inf, 1e6]))
samples = st.lists(st.tuples(moments, st.one_of(st.none(), st.floats(0, 9))), max_size=25)


@settings(max_examples=80)
@given(
    st.lists(samples, min_size=2, max_size=4),
    st.lists(st.booleans(), min_size=4, max_size=4),
    st.integers(1, 30),
    st.integers(1, 30),
)
def test_windows_say_what_the_whole_says(
    time_bases: list[list[tuple[float, float | None]]], ordered: list[bool], window: int, batch: int
) -> None:
    bases = [
        sorted(rows, key=lambda row: row[0]) if flag else rows
        for rows, flag in zip(time_bases, ordered, strict=False)
    ]
    frames = [
        pl.DataFrame(rows, schema={OWN_TIME: pl.Float64, f"v{i}": pl.Float64}, orient="row")
        for i, rows in enumerate(bases)
    ]
    source = FakeSource(frames, batch)
    columns = [f"v{i}" for i in range(len(frames))]
    with mock.patch.object(batches, "WINDOW_ROWS", window):
        windows = list(merge_bases(source.bases(columns), OWN_TIME, ["v0"], GAP_S, columns))
    filled = [rows for rows in bases if rows]
    if len(filled) < 2:
        actual = [row for rows in windows for row in rows.select(OWN_TIME, *columns).rows()]
        expected = [row for frame in frames for row in frame.rows()]
        assert repr([tuple(v for v in row if v is not None) for row in actual]) == repr(
            [tuple(v for v in row if v is not None) for row in expected]
        )
        return
    if not bases[0]:
        return  # the held column is of a base without rows
    value = pl.coalesce(columns).alias("value")
    told_by = [rows.select(BASE, ROW, OWN_TIME, value, DISORDER, HELD + "v0") for rows in windows]
    actual = [row for rows in told_by for row in rows.rows()]
    expected = [row[1:] for row in merged(filled)]
    assert repr(sorted(actual, key=itemgetter(0, 1))) == repr(
        sorted(expected, key=itemgetter(0, 1))
    )
    assert usable(actual) == usable(expected)


def usable(rows: list[tuple[Any, ...]]) -> list[tuple[int, int]]:
    """Base and number of the rows at right times, in their order; where others are is all one."""
    return [
        (base, row) for base, row, time, _, reason, _ in rows if not reason and math.isfinite(time)
    ]


def read_in(
    folder: Path, frames: Sequence[pl.DataFrame], mapping: Any, window: int, batch: int
) -> MeasuredLog | str:
    """Read bases as one file, so many rows at once."""

    def opened(*_: object) -> AbstractContextManager[FakeSource]:
        return nullcontext(FakeSource(frames, batch))

    file = folder / "log.mf4"
    file.write_bytes(b"in memory")
    with ExitStack() as patched:
        patched.enter_context(mock.patch.object(batches, "open_log", opened))
        patched.enter_context(mock.patch.object(batches, "BATCH_ROWS", max(batch // 2, 1)))
        patched.enter_context(mock.patch.object(batches, "WINDOW_ROWS", window))
        patched.enter_context(mock.patch.object(drives, "MAX_VALUES_IN_MEMORY", 40 * window))
        patched.enter_context(mock.patch.object(drives, "MAX_DRIVE_S", 0.8))
        patched.enter_context(mock.patch.object(drives, "MAX_DRIVE_ROWS", 70))
        try:
            return read_measured(file, mapping)
        except InputError as error:
            return str(error)


@st.composite
def clocks(draw: st.DrawFn, rate_hz: float) -> FloatArray:
    """Times of a base: with jitter, gaps, what comes late, twice, or never, and wild ones."""
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    time_s = np.arange(draw(st.floats(0, 1)), 2, 1 / rate_hz)
    if draw(st.booleans()):
        time_s = time_s + rng.normal(0, 0.1 / rate_hz, time_s.size)
    for gap_s in draw(st.lists(st.floats(0, 2), max_size=2)):
        time_s = time_s + (time_s > gap_s) * 1.5
    for late_s in draw(st.lists(st.sampled_from([0.03, 0.4, 2.0, -3.0, -1e5, np.nan]), max_size=4)):
        time_s[rng.integers(0, time_s.size)] -= late_s
    if draw(st.booleans()):
        place = rng.integers(1, time_s.size)
        time_s[place] = time_s[place - 1]
    return np.asarray(time_s[rng.random(time_s.size) > draw(st.sampled_from([0, 0.2]))])


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_the_result_of_a_log_does_not_depend_on_windows(
    tmp_path_factory: Any, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("windows")
    frames = []
    for name in ("ax", "ay", "beta", "fix"):
        rate_hz = 5.0 if name == "fix" else data.draw(st.sampled_from([10.0, 40.0, 100.0, 130.0]))
        time_s = data.draw(clocks(rate_hz))
        values = np.floor(time_s % 3) if name == "fix" else np.sin(3 * time_s)
        values = np.where(np.isfinite(values), values, 0)
        frames.append(pl.DataFrame({OWN_TIME: time_s, name: values}))
    keys: dict[str, Any] = {"unit": "m/s^2"}
    if data.draw(st.booleans()):
        keys["delay_s"] = data.draw(st.floats(-0.2, 0.2))
    more: dict[str, Any] = data.draw(
        st.sampled_from(
            [{}, {"where": [{"column": "fix", "at_least": 1}]}, {"drive": {"column": "fix"}}]
        )
    )
    mapping = a_mapping(
        time={**OWN_CLOCK, "longest_gap_s": 0.15},
        signals={
            "ax": {"column": "ax", **keys},
            "ay": {"column": "ay", "unit": "m/s^2", "longest_gap_s": 0.4},
            "sideslip": {"column": "beta", "unit": "rad"},
        },
        **more,
    )
    expected = read_in(folder, frames, mapping, 10**9, 10**9)
    window, batch = data.draw(st.integers(8, 200)), data.draw(st.integers(8, 200))
    actual = read_in(folder, frames, mapping, window, batch)
    if isinstance(expected, str) or isinstance(actual, str):
        assert actual == expected
        return
    assert actual.drives.equals(expected.drives)
    order = [(name, "ascending") for name in ("row", "reason", "signal")]
    assert actual.quarantine.sort_by(order).equals(expected.quarantine.sort_by(order))
    assert actual.counts == expected.counts


def test_stretches_are_numbered_in_the_order_of_time(tmp_path: Path) -> None:
    """Whatever base the first samples after a gap are of."""
    time_s = np.concatenate([np.arange(0, 0.7, 0.01) + 10 * part for part in range(4)])
    early = {1: 0.004, 2: -0.004, 3: 0.004}
    shifted = time_s + [early.get(int(time // 10), 0) for time in time_s]
    frames = [
        pl.DataFrame({OWN_TIME: 1.7e9 + time_s, "ax": np.sin(time_s)}),
        pl.DataFrame({OWN_TIME: 1.7e9 + shifted, "beta": np.sin(time_s)}),
    ]
    mapping = own_clock(
        signals={
            "ax": {"column": "ax", "unit": "m/s^2"},
            "sideslip": {"column": "beta", "unit": "rad"},
        },
    )
    log = read_in(tmp_path, frames, mapping, 10**9, 10**9)
    assert not isinstance(log, str)
    begins = {row["drive_id"]: row["started_at"] for row in log.drives.to_pylist()}
    assert len(begins) == 4
    assert [begins[name] for name in sorted(begins)] == sorted(begins.values())
    assert len(log.drives["trip_id"].unique()) == 1


steps = st.lists(st.floats(0.0005, 0.09), min_size=3, max_size=60)
lines = st.tuples(st.floats(-100, 100), st.floats(-100, 100))


def times_of(step_s: list[float]) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(step_s)])


@given(steps, lines)
def test_a_linear_signal_is_interpolated_exactly(
    step_s: list[float], line: tuple[float, float]
) -> None:
    t = times_of(step_s)
    at = choose_grid(t, 0.1).at_s
    offset, slope = line
    got = interpolate(t, offset + slope * t, at, longest_gap_s=0.1)
    assert_allclose(got, offset + slope * at, rtol=0, atol=1e-9)
    assert at[0] == t[0]
    assert at[-1] <= t[-1] + 1e-6 < at[-1] + 0.01 + 2e-6


@given(st.lists(st.floats(0.0002, 0.009), min_size=60, max_size=200), lines)
def test_a_linear_signal_is_averaged_exactly(
    step_s: list[float], line: tuple[float, float]
) -> None:
    t = times_of(step_s)
    at = choose_grid(t, 0.001).at_s
    offset, slope = line
    got = average(t, offset + slope * t, at, longest_gap_s=0.1)
    assert_allclose(got, offset + slope * at, rtol=0, atol=1e-8)


@pytest.mark.parametrize("frequency_hz", [5.0, 30.0, 50.0, 90.0, 100.0, 210.0, 400.0])
def test_averaging_has_the_frequency_response_of_a_moving_average(frequency_hz: float) -> None:
    t = np.arange(20_001) / 10_000
    at = choose_grid(t, 0.001).at_s
    phase = 0.4
    got = average(t, np.cos(2 * np.pi * frequency_hz * t + phase), at, longest_gap_s=0.1)
    gain = np.sinc(frequency_hz / 100)
    expected = gain * np.cos(2 * np.pi * frequency_hz * at + phase)
    assert_allclose(got, expected, rtol=0, atol=0.01)


def test_nothing_is_interpolated_across_a_long_gap() -> None:
    t = np.array([0.0, 0.02, 0.04, 0.30, 0.32])
    got = interpolate(t, np.ones(5), choose_grid(t, 0.1).at_s, longest_gap_s=0.1)
    assert np.flatnonzero(~np.isnan(got)).tolist() == [0, 1, 2, 3, 4, 30, 31, 32]


def test_nothing_is_averaged_across_a_long_gap() -> None:
    t = np.concatenate([np.arange(0, 51), np.arange(300, 351)]) / 1000
    got = average(t, np.ones(t.size), choose_grid(t, 0.001).at_s, longest_gap_s=0.1)
    assert np.flatnonzero(~np.isnan(got)).tolist() == [0, 1, 2, 3, 4, 30, 31, 32, 33, 34]


def test_nothing_is_extrapolated() -> None:
    t = np.array([0.06, 0.08, 0.1, 0.12, 0.14])
    got = interpolate(t, np.ones(5), np.arange(21) / 100, longest_gap_s=0.1)
    assert np.flatnonzero(~np.isnan(got)).tolist() == list(range(6, 15))


def test_a_slow_sensor_is_resampled_from_its_own_samples() -> None:
    t, at = np.arange(0, 1.05, 0.1), np.arange(101) / 100
    assert_allclose(interpolate(t, 3 * t, at, longest_gap_s=0.1), 3 * at, atol=1e-12)
    sparse = interpolate(t, 3 * t, at, longest_gap_s=0.05)
    assert np.flatnonzero(~np.isnan(sparse)).tolist() == list(range(0, 101, 10))


def test_an_absent_signal_stays_absent() -> None:
    t, nothing = np.arange(30) / 1000, np.empty(0)
    assert np.isnan(interpolate(nothing, nothing, t, 0.1)).all()
    assert np.isnan(average(nothing, nothing, t, 0.1)).all()


@given(st.lists(st.floats(-0.00095, 0.00095), min_size=2, max_size=100))
def test_jitter_of_a_tenth_of_a_sample_is_snapped(jitter_s: list[float]) -> None:
    jitter = np.array([0.0, *jitter_s])
    t = np.arange(jitter.size) / 100 + jitter
    grid = choose_grid(t, 0.01)
    assert grid.method == "snap"
    assert grid.ticks.tolist() == list(range(t.size))


@pytest.mark.parametrize(
    ("rate_hz", "method"),
    [(10, "interpolate"), (50, "interpolate"), (100, "snap"), (125, "average"), (1000, "average")],
)
def test_the_method_follows_the_rate(rate_hz: float, method: str) -> None:
    assert choose_grid(np.arange(500) / rate_hz, 1 / rate_hz).method == method


def test_a_clock_that_drifts_off_the_ticks_is_resampled() -> None:
    assert choose_grid(np.arange(1000) / 100.5, 1 / 100.5).method == "interpolate"


def test_two_samples_at_one_tick_are_resampled() -> None:
    assert choose_grid(np.array([0, 0.0003, 0.01, 0.02]), 0.01).method == "interpolate"
