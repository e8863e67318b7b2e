"""Gram rows in C99: what a car counts at each tick of a drive, and the messages that tell it.

`docs/export.md` reads the messages in Python. All numbers are little-endian. A message is

    0   4   "FSGR"                          36  8  when the drive began, s since 1970 in UTC
    4   2   layout, 1                       44  4  which signals it is of, a bit for each
    6   2   length with the checksum        48  4  n, rows
    8   8   the set's definition            56  .. sums, 8 bytes each, of these signals
    16  16  the car, ASCII, zeros behind    ..  .. products, 8 bytes each, packed lower triangle
    32  2   place among the drive's         ..  4  CRC-32 of all before, as in Ethernet and zlib
    34  2   number of them
    52  4   rows that are in none of them

A message of another feature set has the layout 3: at 44 over which time (2 bytes, from 0) and the
delay of the course (2 bytes, signed, in quarters of a tick); at 56 which columns of the set it is
of, 64 bytes, a bit for each, the first the lowest; sums from 120 on.

Of each feature set as many rows are counted as no sum of products can reach 2^61 of: nothing
overflows. Columns are computed by the steps of an exported estimator, changes of them as
`fleet_slip.grams.compute.change_sums` does: a fix comes late, so that columns, course and yaw rate
are kept of as many ticks as a change and a delay take, and a tick is counted once its fix is here.
The C stands in `templates/`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from fleet_slip.base import pluralize
from fleet_slip.calibration.intercept import intercept_columns
from fleet_slip.calibration.receiver_delay import delay_columns
from fleet_slip.catalog.calibration_parameters import CALIBRATION, DELAY
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import (
    BESIDE,
    COARSER,
    COURSE,
    LATE_PARTS,
    MOST_EARLY,
    MOST_LATE,
    YAW_RATE,
    course_units,
)
from fleet_slip.catalog.definitions import plain_column
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import HALF_TURN, SAMPLE_TIME_S, SignalCatalog
from fleet_slip.columns.column_sql import rows_of
from fleet_slip.columns.lowering import Lowering
from fleet_slip.errors import RefusedError
from fleet_slip.export.c import StepWriter, helper_texts, keep_lines, start_lines, state_fields
from fleet_slip.export.program import Input, Steps
from fleet_slip.export.templating import field_names, fill_template
from fleet_slip.grams.on_board import (
    MAX_SIGNALS,
    MOST_COLUMNS,
    ROWS_IN_A_SUM,
    OnboardFeatureSet,
    Range,
    most_rows,
    onboard_feature_sets,
)
from fleet_slip.models.manifest import Manifest
from fleet_slip.quality.course_relation import COLUMNS
from fleet_slip.regression.gram import packed_size

# Which Gram rows a car counts beside a model, and what their columns are computed by.
#
# Those of the logged signals; and, if changes of the course taught the model, what teaches it
# again: the changes of its columns, how late the receiver is, what tells the offsets of the
# sensors, and the columns themselves, which the intercept follows from.


@dataclass(frozen=True)
class OnBoard:
    """A feature set as a car counts it.

    Attributes:
        label: name of the label signal.
        of: the set.
        columns: of it that are counted.
        complete: whether rows that lack some of these, and tell nothing then, are left out.
    """

    label: str
    of: OnboardFeatureSet
    columns: tuple[str, ...]
    complete: bool = False

    @property
    def computed(self) -> tuple[str, ...]:
        """The columns that are computed at each tick; of changes, the others come from fixes."""
        from_fixes = (*BESIDE, self.label) if self.of.times else ()
        return tuple(name for name in self.columns if name not in from_fixes)

    @property
    def kept_ticks(self) -> int:
        """Of how many ticks columns are kept: of a change, and of a fix that is late."""
        return max(self.of.times) + 1 + (MOST_LATE if self.of.in_time else 0)

    @property
    def ranges(self) -> list[Range]:
        """The ranges of the columns."""
        return [self.of.ranges[name] for name in self.columns]

    @property
    def places(self) -> list[int]:
        """Which columns of the set they are."""
        return [self.of.columns.index(name) for name in self.columns]


def sets_on_board(catalog: Catalog, manifest: Manifest) -> tuple[OnBoard, ...]:
    """Return what a car counts that has a model, the logged signals first.

    Raises `QuestionError` if the model's feature set is defined otherwise now, and `RefusedError`
    for one that cars cannot count.
    """
    label, counted_set = catalog.signals.label, onboard_feature_sets(catalog)

    def whole(name: str) -> OnBoard:
        counted = counted_set[catalog.identity(name)]
        return OnBoard(label, counted, counted.columns)

    plain = whole(PLAIN)
    if manifest.learned_from is None:
        return (plain,)
    name = catalog.name_of(manifest.trained_on.feature_set)
    counted = counted_set.get(catalog.identity(name))
    if counted is None:
        raise RefusedError(f"cars cannot count the feature set {name}: it has too many columns.")
    calibrated = catalog.calibrated
    used = {calibrated[one].of if one in calibrated else one for one in manifest.signals}
    used |= {*COLUMNS, *BESIDE, label}
    columns = tuple(column for column in counted.columns if column in used)
    over_time = [name for name in columns if name in catalog.time_columns]
    unknown = [
        name
        for name in over_time
        if any(part.fact for part in catalog.time_columns[name].definition.parts)
    ]
    if unknown or len(columns) > MAX_SIGNALS:
        has = unknown[0] if unknown else pluralize(len(columns), "column")
        raise RefusedError(
            f"{manifest.name} has {has}: cars count up to {MAX_SIGNALS} columns of a feature set, "
            "and no properties of the car. Export without them: fleet-slip export NAME --to c"
        )
    delay = counted_set[catalog.identity(DELAY)]
    of_delay = tuple(column for column in delay.columns if column in delay_columns())
    delays = OnBoard(label, delay, of_delay, complete=True)
    sets = (plain, OnBoard(label, counted, columns), delays, whole(CALIBRATION))
    if manifest.through_origin:
        return sets
    base, levels = intercept_columns(catalog, name, manifest.signals)
    source = counted_set[catalog.identity(base)]
    columns = tuple(name for name in source.columns if name in {*levels, label})
    return (*sets, OnBoard(label, source, columns))


def lower(catalog: Catalog, sets: Sequence[OnBoard]) -> tuple[Steps, Mapping[str, int]]:
    """Return the steps of all columns, and the step of each by its name."""
    used = {name for one in sets for name in one.of.signals}
    names = dict.fromkeys(name for one in sets for name in one.computed)
    if any(one.of.times for one in sets):
        names |= dict.fromkeys((COURSE, YAW_RATE))
    windows = {
        name: catalog.time_columns[name].definition
        for name in names
        if name in catalog.time_columns
    }
    single = {name: plain_column(name) for name in names if name not in windows}
    rows = rows_of(single | catalog.rows(names), windows)
    used &= {signal for row in rows.values() for signal in row.signals}
    inputs = tuple(
        Input(name, one.column, one.unit, one.scale, one.min_count, one.max_count)
        for name, one in catalog.signals.signals.items()
        if name in used
    )
    lowered = Lowering({one.name: place for place, one in enumerate(inputs)})
    places = {name: lowered.row(row) for name, row in rows.items()}
    places |= {name: lowered.column(one) for name, one in windows.items()}
    found = Steps(inputs, tuple(lowered.facts), tuple(lowered.numbers), tuple(lowered.steps))
    return found, places


MAGIC = b"FSGR"
LAYOUT, SET_LAYOUT = 1, 3
HEADER_BYTES, CHECKSUM_BYTES = 56, 4
LONGEST_VEHICLE = 16
MOST_PARTS = 4
"""Sets of signals that a car keeps apart within a drive."""

_HELPER = re.compile(r"^static \w+ (\w+)\(", re.MULTILINE)


def c_gram_header(catalog: Catalog, prefix: str, sets: Sequence[OnBoard]) -> str:
    """Return the header: what is kept, and the functions."""
    return fill_template("templates/gram.h", **_words(catalog, prefix, sets))


def c_gram_source(catalog: Catalog, prefix: str, sets: Sequence[OnBoard]) -> str:
    """Return the source that goes with the header."""
    text = fill_template("templates/gram.c", **_words(catalog, prefix, sets))
    for name in _HELPER.findall(text):  # the model's own functions may have these names
        text = re.sub(rf"\b{name}\(", f"gram_{name}(", text)
    return text


def _words(catalog: Catalog, prefix: str, sets: Sequence[OnBoard]) -> Mapping[str, Any]:
    """Return the words of the templates of header and source."""
    steps, places = lower(catalog, sets)
    writer = StepWriter(steps)
    changed = [(number, one) for number, one in enumerate(sets) if one.of.times]
    rows = [[writer.kept(places[name]) for name in one.computed] for one in sets]
    parts = [MOST_PARTS * max(1, len(one.of.times)) for one in sets]
    sizes = [len(one.columns) + packed_size(len(one.columns)) for one in sets]
    numbers = [part * size for part, size in zip(parts, sizes, strict=True)]
    words: dict[str, Any] = {
        "prefix": prefix,
        "upper": prefix.upper(),
        "program": steps,
        "fields": field_names(steps),
        "sets": sets,
        "changed": changed,
        "rows": rows,
        "most_parts": MOST_PARTS,
        "most_rows": ROWS_IN_A_SUM,
        "parts": sum(parts),
        "numbers": sum(numbers),
        "longest_vehicle": LONGEST_VEHICLE,
        "longest_message": max(
            HEADER_BYTES + MOST_COLUMNS // 8 * (number > 0) + 8 * size + CHECKSUM_BYTES
            for number, size in enumerate(sizes)
        ),
        "header_bytes": HEADER_BYTES,
        "magic": MAGIC,
        "layout": LAYOUT,
        "set_layout": SET_LAYOUT,
        "counted": _counted(sets, parts, numbers),
    }
    if changed:
        words |= _words_of_changes(catalog.signals, steps, writer, places, sets, changed)
    words |= {"lines": [*writer.lines, *words.get("keeps", ())], "helpers": helper_texts(writer)}
    return words


def _counted(
    sets: Sequence[OnBoard], parts: Sequence[int], numbers: Sequence[int]
) -> list[list[str]]:
    """Return the table of sets, a field of `counted_set` each."""
    firsts = zip(accumulate(parts, initial=0), accumulate(numbers, initial=0), strict=True)
    return [
        [
            f"{len(one.columns)}U",
            f"{part}U",
            f"{first_part}U",
            f"{first_number}U",
            f"{most_rows(one.ranges)}U",
            f"0x{one.of.definition:016X}ULL",
            "true" if one.complete else "false",
        ]
        for one, part, (first_part, first_number) in zip(sets, parts, firsts, strict=False)
    ]


def _words_of_changes(
    signals: SignalCatalog,
    steps: Steps,
    writer: StepWriter,
    places: Mapping[str, int],
    sets: Sequence[OnBoard],
    changed: Sequence[tuple[int, OnBoard]],
) -> dict[str, Any]:
    """Return the words of what counts changes of columns from fix to fix."""
    units, track = course_units(signals), max(one.kept_ticks for _, one in changed)
    course, yaw_rate = (writer.kept(places[name]) for name in (COURSE, YAW_RATE))
    keeps = keep_lines(steps, writer)
    writer.done["nearest_64"] += 1
    constants = {
        "CHANGED": f"{len(changed)}U",
        "MOST_TIMES": f"{max(len(one.of.times) for _, one in changed)}U",
        "MOST_COLUMNS": f"{max(len(one.computed) for _, one in changed) + len(BESIDE) + 1}U",
        "TRACK": f"{track}U",
        "TURN": f"INT64_C({units.turn})",
        "COURSE_COUNTS": f"INT64_C({2 * HALF_TURN})",
        "DIVISOR": f"INT64_C({units.divisor})",
        "LARGEST": f"INT64_C({units.largest})",
        "SLOW": units.slow,
        "UNTURNED": units.unturned,
        "COARSER": COARSER,
        "LATE_PARTS": LATE_PARTS,
        "ROUND_LATE": LATE_PARTS // 2,
        "EARLIEST": -MOST_EARLY,
        "GAIN": f"INT64_C({4 * HALF_TURN // LATE_PARTS})",
    }
    firsts = list(accumulate((len(one.columns) for one in sets), initial=0))
    return {
        "track": track,
        "state": [one for one in state_fields(steps) if one.name != "nothing"],
        "start": start_lines(steps, writer),
        "keeps": keeps,
        "course": course,
        "yaw_rate": yaw_rate,
        "constants": constants,
        "earliest": LATE_PARTS * MOST_EARLY,
        "latest": LATE_PARTS * MOST_LATE,
        "late_ms": f"{1000 * float(SAMPLE_TIME_S) / LATE_PARTS:g}",
        "columns_bytes": MOST_COLUMNS // 8,
        "places": [place for one in sets for place in one.places],
        "firsts": firsts[:-1],
    }
