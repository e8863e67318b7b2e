"""Reads the rows of a log, which is a file or several, in bounded batches.

A batch is a Polars frame with the columns that a mapping uses: text (CSV, text in Parquet), 64-bit
floats, dates or timestamps. CSV fields stay text, so that what is not a number can be quarantined
as it was written. A time base goes on from file to file, each open only while it is read.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from collections.abc import Mapping as Named
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.base import shown
from fleet_slip.catalogue.signals import catalogue, round_chunks
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import describe
from fleet_slip.ingest.formats.reading import file_errors, open_source
from fleet_slip.ingest.formats.source import BASE, Base, Budget, Meter, Source
from fleet_slip.ingest.formats.tables import BATCH_ROWS
from fleet_slip.ingest.log_files import parts_of
from fleet_slip.ingest.mapping import SPEEDS, LabelSensor, Mapping
from fleet_slip.ingest.raw_columns import (
    LONGEST_TEXT,
    RAW,
    REASONS,
    ROW,
    Field,
    fields_of,
    meets_conditions,
    merge_bases,
)

_OpenIt = Callable[[Path], AbstractContextManager[tuple[list[Base], set[str]]]]

_CLOCK = "this file says when each sample was taken: write own_clock = true under [time]"
_NO_CLOCK = "this file has no clock of its own: write column or rate_hz under [time]"


@dataclass
class _Opened:
    """An open file, its time bases, their columns, and how many of them are being read."""

    file: ExitStack
    bases: list[Base]
    columns: set[str]
    readers: int = 0


class PartBases:
    """Opens the files of a log, each once for all who read a time base of it at a time."""

    def __init__(self, open_it: _OpenIt) -> None:
        """Take what opens a file: it gives its time bases, and which columns they have."""
        self._open_it = open_it
        self._opened: dict[Path, _Opened] = {}

    def __enter__(self) -> "PartBases":
        """Begin without open files."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close what readers have left open."""
        for part in [*self._opened]:
            self._opened.pop(part).file.close()

    @contextmanager
    def using(self, part: Path) -> Iterator[_Opened]:
        """Give a file, open as long as somebody uses it."""
        if part not in self._opened:
            with ExitStack() as file:
                bases, columns = file.enter_context(self._open_it(part))
                self._opened[part] = _Opened(file.pop_all(), bases, columns)
        opened = self._opened[part]
        opened.readers += 1
        try:
            with file_errors(part):
                yield opened
        finally:
            opened.readers -= 1
            if not opened.readers and self._opened.get(part) is opened:
                del self._opened[part]
                opened.file.close()


class _Stretch(NamedTuple):
    """The rows of a time base in one file: which of its bases it is, and how many there are."""

    part: Path
    place: int
    first_s: float
    rows: int


def join_parts(log: Path, parts: list[Path], mapping: Mapping, opened: PartBases) -> list[Base]:
    """Return the time bases of a log: what has the same columns goes on from file to file.

    Files follow each other in the order of their first times. Raises `InputError` for a column that
    no file has.
    """
    time = str(mapping.time.key)
    missing = {name for names in mapping.time_bases().values() for name in names}
    found: dict[str, list[_Stretch]] = defaultdict(list)
    for part in parts:
        with opened.using(part) as there:
            missing -= there.columns
            for place, base in enumerate(there.bases):
                first = next(base.read())
                name = " ".join(sorted({*first.columns, time}))
                least = first[time].min()
                first_s = least if isinstance(least, float) else 0.0
                found[name].append(_Stretch(part, place, first_s, base.count_rows()))
    if missing:
        raise InputError(f"{shown(log)}: no file in it has the column {min(missing)!r}.")
    for stretches in found.values():
        stretches.sort(key=lambda stretch: stretch.first_s)
    names = sorted(found, key=lambda name: found[name][0].first_s)
    return [
        Base(
            name,
            partial(sum, [stretch.rows for stretch in found[name]]),
            partial(_read, opened, found[name]),
        )
        for name in names
    ]


def _read(opened: PartBases, stretches: list[_Stretch]) -> Iterator[pl.DataFrame]:
    for stretch in stretches:
        with opened.using(stretch.part) as there:
            yield from there.bases[stretch.place].read()


def read_batches(log: Path, mapping: Mapping, meter: Meter | None = None) -> Iterator[pl.DataFrame]:
    """Yield the columns of a log that a mapping uses, in its order, in bounded batches.

    Rows of several time bases come as `merge_bases` says. The meter gets how many rows come.
    Raises `InputError` if a file cannot be read, or a column is missing or ambiguous.
    """
    meter = meter or Meter()
    wanted, parts, time = mapping.time_bases(), parts_of(log), mapping.time.key
    if time is None or (len(wanted) == 1 and not mapping.time.own_clock):
        for part in parts:
            with _open_part(part, mapping) as source:
                columns = next(iter(wanted.values()))
                if meter.is_watched and part == parts[0]:
                    meter.expect(source.expected_rows(columns), of=part.stat().st_size)
                yield from Budget.of(part).metered(source.batches(columns))
    elif len(parts) == 1:
        with _open_part(log, mapping) as source:
            bases = _bases_of(source, log, mapping, wanted)
            if meter.is_watched:
                meter.expect(sum(map(source.expected_rows, wanted.values())))
            yield from _merged(bases, mapping)
    else:
        with PartBases(partial(_open_bases, mapping)) as opened:
            bases = join_parts(log, parts, mapping, opened)
            meter.expect(sum(base.count_rows() for base in bases))
            yield from _merged(bases, mapping)


def _merged(bases: list[Base], mapping: Mapping) -> Iterator[pl.DataFrame]:
    """Yield the rows of time bases as those of one table."""
    time, held = str(mapping.time.key), mapping.common_columns()
    for rows in merge_bases(bases, time, held, mapping.time.split_gap_s):
        yield from rows.iter_slices(BATCH_ROWS)


@contextmanager
def _open_part(part: Path, mapping: Mapping) -> Iterator[Source]:
    """Open a file that says times as the mapping does. Raises `InputError`."""
    with file_errors(part), open_source(part, mapping.formats) as source:
        if source.has_clock != mapping.time.own_clock:
            raise InputError(
                f"{shown(part)}: {_CLOCK if source.has_clock else _NO_CLOCK}, in the mapping "
                f"{mapping.name!r}."
            )
        yield source


@contextmanager
def _open_bases(mapping: Mapping, part: Path) -> Iterator[tuple[list[Base], set[str]]]:
    """Open a file, which may lack wanted columns; yield its time bases, and the columns it has."""
    wanted = mapping.time_bases()
    with _open_part(part, mapping) as source:
        names = {channel.name for channel in source.channels()}
        # What several groups of one file have is called NAME@GROUP, there only.
        all_names = {name for columns in wanted.values() for name in columns}
        there = names | {name for name in all_names if name.rpartition("@")[0] in names}
        found = {
            own: [name for name in columns if name in there]
            for own, columns in wanted.items()
            if own is None or own in there
        }
        found = {own: columns for own, columns in found.items() if columns}
        columns = {name for columns in found.values() for name in columns}
        yield _bases_of(source, part, mapping, found), columns


def _bases_of(
    source: Source, part: Path, mapping: Mapping, wanted: dict[str | None, list[str]]
) -> list[Base]:
    """Return the time bases of a file that have one of the wanted columns."""
    if source.has_clock:
        bases = [base for columns in wanted.values() for base in source.bases(columns)]
    else:
        time = str(mapping.time.key)
        bases = [
            Base(
                str(own),
                partial(_count_rows, source, str(own), own == time),
                partial(_read_with_times, source, part, columns, str(own), time),
            )
            for own, columns in wanted.items()
        ]

    def metered(read: Callable[[], Iterator[pl.DataFrame]]) -> Iterator[pl.DataFrame]:
        return Budget.of(part).metered(read())

    return [replace(base, read=partial(metered, base.read)) for base in bases]


def _count_rows(source: Source, own: str, is_main: bool) -> int:
    """Return how many rows a base has: those with a time, where it has times of its own."""
    batches = source.batches([own])
    return sum(batch.height - (0 if is_main else batch[own].null_count()) for batch in batches)


def _read_with_times(
    source: Source, part: Path, columns: list[str], own: str, time: str
) -> Iterator[pl.DataFrame]:
    """Yield the rows of a base, its times under the name that all times have."""
    for batch in source.batches(columns):
        if not batch[own].dtype.is_numeric():
            raise InputError(
                f"{shown(part)}: the time {own!r} is not of numbers; signals with times of their "
                "own need them."
            )
        if own == time:
            yield batch
        else:
            yield batch.filter(pl.col(own).is_not_null()).rename({own: time})


# Each row is checked by itself: values in SI units of good ones, the reason of bad ones.

MAX_KEYS = 100_000
"""Combinations of drive metadata in one file, of whatever rows."""
_PROBLEM = "problem"


class CheckedBlock(NamedTuple):
    """Some rows of a file: the good ones, the bad ones, and how many were read until its end."""

    rows: pl.DataFrame
    refused: pl.DataFrame
    read: int


class RowChecker:
    """The rows of a file, good and bad, and what was counted on the way.

    Attributes:
        rows: read so far.
        left_out: of these, those that do not meet the mapping's conditions.
        keys: what the numbers in the column `group` stand for.
    """

    def __init__(self, file: Path, mapping: Mapping, meter: Meter) -> None:
        """Take a file that is not open yet."""
        self._file, self._mapping, self._meter = file, mapping, meter
        self.rows = self.left_out = 0
        self.keys = DriveKeys()

    def blocks(self) -> Iterator[CheckedBlock]:
        """Yield the rows of each batch. Raises `InputError`."""
        for batch in read_batches(self._file, self._mapping, self._meter):
            yield self._check(batch)
        if not self.rows:
            raise InputError(f"{shown(self._file)}: it has a header and no rows. Export it again.")
        if self.left_out == self.rows:
            raise InputError(
                f"{shown(self._file)}: none of its {self.rows:,} rows meets the condition of the "
                f"mapping {self._mapping.name!r}: {describe(self._mapping.where)}."
            )

    def _check(self, batch: pl.DataFrame) -> CheckedBlock:
        raw = batch.select(pl.all().name.prefix(RAW))
        try:
            fields, meeting = _understand(self._mapping, tuple(raw.schema.items()))
        except InputError as error:
            raise InputError(f"{shown(self._file)}: {error}") from None
        if RAW + ROW in raw.columns:
            raw = raw.rename({RAW + ROW: "row"})
        else:
            row = pl.int_range(self.rows + 1, self.rows + batch.height + 1, dtype=pl.Int64)
            raw = raw.with_columns(row.alias("row"))
        if meeting is not None:
            raw = raw.filter(meeting)
        raw = raw.rename({RAW + BASE: "base"}, strict=False)
        self.rows += batch.height
        self.left_out += batch.height - raw.height
        valued = raw.with_columns(f.value.alias(f.name) for f in fields if f.kind != "condition")
        rows, refused = _split(self.keys.number(valued, fields), fields)
        if len(self.keys) > MAX_KEYS:
            raise InputError(
                f"{shown(self._file)}: more than {MAX_KEYS:,} combinations of drive metadata. "
                f"Check the columns under [drive] in the mapping {self._mapping.name!r}."
            )
        if self._mapping.time.rate_hz is not None:
            rows = rows.with_columns((pl.col("row") / self._mapping.time.rate_hz).alias("time"))
        return CheckedBlock(rows, refused, self.rows)


@lru_cache(maxsize=64)
def _understand(
    mapping: Mapping, columns: tuple[tuple[str, pl.DataType], ...]
) -> tuple[list[Field], pl.Expr | None]:
    """Return the fields of batches with these columns: the same for all files of a folder."""
    schema = pl.Schema(columns)
    fields = fields_of(mapping, schema)
    return fields, meets_conditions(mapping, schema) if mapping.where else None


class DriveKeys:
    """Numbers the combinations of drive metadata in a file, from 0, in order of appearance."""

    def __init__(self) -> None:
        """Begin without any."""
        self._numbers: dict[tuple[Any, ...], int] = {}
        self.metadata: list[dict[str, Any]] = []
        """What each number stands for."""

    def __len__(self) -> int:
        """Return how many there are so far."""
        return len(self._numbers)

    def number(self, batch: pl.DataFrame, fields: list[Field]) -> pl.DataFrame:
        """Add `group` to a batch with values: the row's number, null where its key is faulty.

        A key are the fields of the kind `key`; without any, the whole file is number 0.
        """
        of_key = [field for field in fields if field.kind == "key"]
        if not of_key:
            self.metadata = self.metadata or [{}]
            return batch.with_columns(pl.lit(0, pl.Int32).alias("group"))
        names = [field.name for field in of_key]
        sound = pl.all_horizontal([field.problem.is_null() for field in of_key])
        keys = batch.filter(sound).select(names).unique(maintain_order=True)
        numbers = [self._number(dict(zip(names, key, strict=True))) for key in keys.rows()]
        keys = keys.with_columns(pl.Series("group", numbers, pl.Int32))
        joined = batch.join(keys, on=names, how="left", nulls_equal=True, maintain_order="left")
        return joined.with_columns(pl.when(sound).then("group").alias("group"))

    def _number(self, key: dict[str, Any]) -> int:
        number = self._numbers.setdefault(tuple(key.values()), len(self._numbers))
        if number == len(self.metadata):
            self.metadata.append(key)
        return number


def _split(batch: pl.DataFrame, fields: list[Field]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split a batch into good rows, in SI units, and bad ones, by the first problem of each."""
    values = [field.name for field in fields if field.kind in {"time", "signal"}]
    kept = ["row", "group", *({"base"} & set(batch.columns)), *values]
    codes = [
        field.problem + len(REASONS) * i
        for i, field in enumerate(fields)
        if not field.is_sound(batch)
    ]
    if not codes:
        return batch.select(kept), no_rows()
    checked = batch.with_columns(pl.coalesce(codes).alias(_PROBLEM))
    good = checked.filter(pl.col(_PROBLEM).is_null()).select(kept)
    bad = checked.filter(pl.col(_PROBLEM).is_not_null())
    explained = [_explain(rows, fields) for rows in bad.partition_by(_PROBLEM)]
    return good, pl.concat([no_rows(), *explained])


def describe_refused(rows: pl.DataFrame, which: BoolArray | None, reason: str) -> pl.DataFrame:
    """Return rows as bad ones, because of their time: those of a mask, or all."""
    bad = rows if which is None else rows.filter(pl.Series(which))
    return bad.select(
        pl.col("row"),
        pl.col("group"),
        pl.lit(reason).alias("reason"),
        pl.lit("time").alias("signal"),
        pl.col("time").cast(pl.String).alias("value"),
    )


def join_refused(frames: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Return the bad rows of all frames; most have none, and joining takes a while."""
    some = [frame for frame in frames if frame.height]
    return pl.concat(some) if len(some) > 1 else next(iter(some), frames[0])


@cache
def no_rows() -> pl.DataFrame:
    """Return an empty frame of bad rows."""
    names = {"row": pl.Int64, "group": pl.Int32, "reason": pl.String}
    return pl.DataFrame(schema={**names, "signal": pl.String, "value": pl.String})


def _explain(bad: pl.DataFrame, fields: list[Field]) -> pl.DataFrame:
    """Describe rows that all have the same problem."""
    index, reason = divmod(bad[_PROBLEM][0], len(REASONS))
    field = fields[index]
    return bad.select(
        "row",
        "group",
        pl.lit(REASONS[reason]).alias("reason"),
        pl.lit(field.name or None, pl.String).alias("signal"),
        field.raw.cast(pl.String).str.slice(0, LONGEST_TEXT).alias("value"),
    )


# The label is brought to the centre of gravity: with the yaw rate r, a sensor x before it and y to
# its left has the velocities (vx - r y, vy + r x). Of an angle alone the speed is needed beside it.

RADIUS_M = 0.31
"""Of a wheel whose mapping names none; a tenth more moves the correction by a tenth."""
LEAST_SPEED_MPS = 2.0
"""Below it two velocities give no angle, and an angle is not moved."""


def physical(counts: Named[str, pa.Array], name: str) -> FloatArray:
    """Return a signal in SI units, NaN where there is none."""
    values = pl.Series(counts[name]).cast(pl.Float64).fill_null(float("nan")).to_numpy()
    return np.asarray(values * float(catalogue()[name].scale))


def place_label(mapping: Mapping, counts: Named[str, pa.Array]) -> dict[str, pa.Array]:
    """Return the counts of the label at the centre of gravity, and of velocities it is made of."""
    sensor = mapping.label
    if sensor is None:
        return {}
    found = _velocities(sensor, counts) if sensor.from_velocities else _angle(mapping, counts)
    return {name: round_chunks([values], catalogue()[name]) for name, values in found.items()}


def _velocities(sensor: LabelSensor, counts: Named[str, pa.Array]) -> dict[str, FloatArray]:
    vx, vy = physical(counts, "vx"), physical(counts, "vy")
    if sensor.is_elsewhere:
        yaw_rate = physical(counts, "yaw_rate")
        vx, vy = vx + yaw_rate * sensor.sensor_y_m, vy - yaw_rate * sensor.sensor_x_m
    fast = np.hypot(vx, vy) >= LEAST_SPEED_MPS
    return {"vx": vx, "vy": vy, catalogue().label: np.where(fast, np.arctan2(vy, vx), np.nan)}


def _angle(mapping: Mapping, counts: Named[str, pa.Array]) -> dict[str, FloatArray]:
    sensor, label = mapping.label, catalogue().label
    if sensor is None or not sensor.is_elsewhere:
        return {}
    angle, yaw_rate = physical(counts, label), physical(counts, "yaw_rate")
    speed = _speed(mapping, counts)
    vx = speed * np.cos(angle) + yaw_rate * sensor.sensor_y_m
    vy = speed * np.sin(angle) - yaw_rate * sensor.sensor_x_m
    return {label: np.where(speed >= LEAST_SPEED_MPS, np.arctan2(vy, vx), np.nan)}


def _speed(mapping: Mapping, counts: Named[str, pa.Array]) -> FloatArray:
    """Return the car's speed: as it is logged, or that of its wheels."""
    for name in SPEEDS:
        if name in counts:
            return np.abs(physical(counts, name))
    wheels = [name for name in counts if name.startswith("wheel_")]
    speeds = [physical(counts, n) * (mapping.signals[n].radius_m or RADIUS_M) for n in wheels]
    return np.asarray(np.median(speeds, axis=0), dtype=np.float64)
