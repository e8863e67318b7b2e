"""Gram rows in C99: counts of a car at each tick of a drive, and the messages that transmit them.

`docs/export.md` decodes the messages in Python. All numbers are little-endian. A message is

    0   4   "FSGR"                          36  8  start of the drive, s since 1970 in UTC
    4   2   layout, 1                       44  4  signals of the row, one bit each
    6   2   length including the checksum   48  4  n, number of rows
    8   8   definition of the set           56  .. sums of these signals, 8 bytes each
    16  16  the car, ASCII, zero-padded     ..  .. products, 8 bytes each, packed lower triangle
    32  2   index of the block              ..  4  CRC-32 of all bytes before (Ethernet, zlib)
    34  2   number of blocks of the drive
    52  4   rows that were not counted

A message of another feature set has the layout 3. At 44 it has the index of the time of its changes
(2 bytes) and the delay of the course (2 bytes, signed, in quarters of a tick). At 56 it has the
columns of the set, 64 bytes with one bit each, the first one lowest. Its sums start at 120.

The number of rows of a feature set is limited so that no sum of products reaches 2^61. Columns are
computed by the steps of an exported estimator, and their changes as in
`fleet_slip.grams.compute.change_sums`. A fix is late: columns, course and yaw rate are stored for
the ticks of a change and of the delay, and a tick is counted when its fix arrives.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from fleet_slip.base import pluralize
from fleet_slip.calibration.course_label import intercept_columns
from fleet_slip.calibration.receiver_delay import delay_columns
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.course import (
    AUXILIARY,
    COURSE,
    LATE_PARTS,
    MAX_COURSE_DELAY,
    MIN_COURSE_DELAY,
    TURNED_DIVISOR,
    YAW_RATE,
    course_units,
)
from fleet_slip.catalog.definitions import CALIBRATION, DELAY, plain_column
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import HALF_TURN, SAMPLE_TIME_S
from fleet_slip.columns.column_sql import rows_of
from fleet_slip.columns.lowering import Lowering
from fleet_slip.errors import RefusedError
from fleet_slip.export.c import StepWriter, helper_texts, keep_lines, start_lines, state_fields
from fleet_slip.export.program import Input, Steps
from fleet_slip.export.templating import field_names, fill_template
from fleet_slip.grams.on_board import (
    MAX_COLUMNS,
    MAX_SIGNALS,
    ROWS_IN_A_SUM,
    OnboardFeatureSet,
    max_gram_rows,
    onboard_feature_sets,
)
from fleet_slip.models.manifest import Manifest
from fleet_slip.quality.course_relation import COLUMNS
from fleet_slip.regression.gram import packed_size

# A car counts Gram rows of the logged signals. If the model was trained on changes of the course,
# the car also counts changes of its columns, columns for the delay of the receiver and the offsets
# of sensors, and the columns themselves for the intercept.


@dataclass(frozen=True)
class OnBoard:
    """The columns of a feature set that a car counts."""

    label: str
    """Name of the label signal."""
    counted: OnboardFeatureSet
    columns: tuple[str, ...]
    complete: bool = False
    """True: rows with some, but not all columns are not counted."""

    @property
    def computed(self) -> tuple[str, ...]:
        """Columns that are computed at each tick; others of a change come from fixes."""
        from_fixes = (*AUXILIARY, self.label) if self.counted.times else ()
        return tuple(name for name in self.columns if name not in from_fixes)

    @property
    def history_ticks(self) -> int:
        """Ticks of stored columns: those of a change, and of the delay of a fix."""
        return max(self.counted.times) + 1 + (MAX_COURSE_DELAY if self.counted.in_time else 0)

    @property
    def places(self) -> list[int]:
        """Positions of the columns in the set."""
        return [self.counted.columns.index(name) for name in self.columns]


def sets_on_board(catalog: Catalog, manifest: Manifest) -> tuple[OnBoard, ...]:
    """Return the sets that a car with a model counts, the logged signals first.

    Raises `QuestionError` if the definition of the model's feature set has changed, and
    `RefusedError` for a set that cars cannot count.
    """
    label, counted_set = catalog.signals.label, onboard_feature_sets(catalog)

    def all_columns(name: str) -> OnBoard:
        counted = counted_set[catalog.identity(name)]
        return OnBoard(label, counted, counted.columns)

    plain = all_columns(PLAIN)
    if manifest.learned_from is None:
        return (plain,)
    name = catalog.name_of(manifest.trained_on.feature_set)
    counted = counted_set.get(catalog.identity(name))
    if counted is None:
        raise RefusedError(
            f"cars cannot count the feature set {name}: it has more than {MAX_COLUMNS} columns. "
            "Export without them: fleet-slip export NAME --to c"
        )
    calibrated = catalog.calibrated
    used = {calibrated[name].of if name in calibrated else name for name in manifest.signals}
    used |= {*COLUMNS, *AUXILIARY, label}
    columns = tuple(column for column in counted.columns if column in used)
    over_time = [name for name in columns if name in catalog.time_columns]
    with_attribute = [
        name
        for name in over_time
        if any(part.fact for part in catalog.time_columns[name].definition.components)
    ]
    if with_attribute or len(columns) > MAX_SIGNALS:
        has = with_attribute[0] if with_attribute else pluralize(len(columns), "column")
        raise RefusedError(
            f"{manifest.name} has {has}: cars count up to {MAX_SIGNALS} columns of a feature set, "
            "and no properties of the car. Export without them: fleet-slip export NAME --to c"
        )
    delay = counted_set[catalog.identity(DELAY)]
    delay_names = tuple(column for column in delay.columns if column in delay_columns())
    delays = OnBoard(label, delay, delay_names, complete=True)
    sets = (plain, OnBoard(label, counted, columns), delays, all_columns(CALIBRATION))
    if manifest.through_origin:
        return sets
    base, levels = intercept_columns(catalog, name, manifest.signals)
    source = counted_set[catalog.identity(base)]
    columns = tuple(name for name in source.columns if name in {*levels, label})
    return (*sets, OnBoard(label, source, columns))


def lower(catalog: Catalog, sets: Sequence[OnBoard]) -> tuple[Steps, Mapping[str, int]]:
    """Return the steps of all columns, and the step of each column by name."""
    used = {name for on_board in sets for name in on_board.counted.signals}
    names = dict.fromkeys(name for on_board in sets for name in on_board.computed)
    if any(on_board.counted.times for on_board in sets):
        names |= dict.fromkeys((COURSE, YAW_RATE))
    windows = {n: catalog.time_columns[n].definition for n in names if n in catalog.time_columns}
    single = {name: plain_column(name) for name in names if name not in windows}
    rows = rows_of(single | catalog.rows(names), windows)
    used &= {signal for row in rows.values() for signal in row.signals}
    inputs = tuple(
        Input(name, s.column, s.unit, s.scale, s.min_count, s.max_count)
        for name, s in catalog.signals.signals.items()
        if name in used
    )
    lowered = Lowering({signal.name: place for place, signal in enumerate(inputs)})
    places = {name: lowered.row(row) for name, row in rows.items()}
    places |= {name: lowered.column(window) for name, window in windows.items()}
    steps = Steps(inputs, tuple(lowered.facts), tuple(lowered.numbers), tuple(lowered.steps))
    return steps, places


MAGIC = b"FSGR"
LAYOUT, SET_LAYOUT = 1, 3
HEADER_BYTES, CHECKSUM_BYTES = 56, 4
MAX_VEHICLE_BYTES = 16
MAX_BLOCKS = 4
"""Blocks of a drive: rows are counted separately for each combination of valid signals."""

_HELPER = re.compile(r"^static \w+ (\w+)\(", re.MULTILINE)


def c_gram_header(catalog: Catalog, prefix: str, sets: Sequence[OnBoard]) -> str:
    """Return the header: state and functions."""
    return fill_template("templates/gram.h", **_words(catalog, prefix, sets))


def c_gram_source(catalog: Catalog, prefix: str, sets: Sequence[OnBoard]) -> str:
    """Return the source of the header."""
    text = fill_template("templates/gram.c", **_words(catalog, prefix, sets))
    for name in _HELPER.findall(text):  # functions of the model can have the same names
        text = re.sub(rf"\b{name}\(", f"gram_{name}(", text)
    return text


def _words(catalog: Catalog, prefix: str, sets: Sequence[OnBoard]) -> Mapping[str, Any]:
    """Return the words of the templates of header and source."""
    steps, places = lower(catalog, sets)
    writer = StepWriter(steps)
    changed = [(i, on_board) for i, on_board in enumerate(sets) if on_board.counted.times]
    rows = [[writer.word(places[name]) for name in on_board.computed] for on_board in sets]
    blocks = [MAX_BLOCKS * max(1, len(on_board.counted.times)) for on_board in sets]
    widths = [len(on_board.columns) for on_board in sets]
    sizes = [width + packed_size(width) for width in widths]
    numbers = [count * size for count, size in zip(blocks, sizes, strict=True)]
    message_bytes = [HEADER_BYTES + 8 * size + CHECKSUM_BYTES for size in sizes]
    message_bytes[1:] = [size + MAX_COLUMNS // 8 for size in message_bytes[1:]]
    words: dict[str, Any] = {
        "prefix": prefix,
        "upper": prefix.upper(),
        "program": steps,
        "fields": field_names(steps),
        "sets": sets,
        "changed": changed,
        "rows": rows,
        "max_blocks": MAX_BLOCKS,
        "max_rows": ROWS_IN_A_SUM,
        "row_limits": [max_gram_rows([s.counted.ranges[c] for c in s.columns]) for s in sets],
        "blocks": blocks,
        "first_blocks": [0, *accumulate(blocks[:-1])],
        "numbers": numbers,
        "first_numbers": [0, *accumulate(numbers[:-1])],
        "max_vehicle": MAX_VEHICLE_BYTES,
        "max_message": max(message_bytes),
        "header_bytes": HEADER_BYTES,
        "magic": MAGIC,
        "layout": LAYOUT,
        "set_layout": SET_LAYOUT,
    }
    if changed:
        state = [field for field in state_fields(steps) if field.name != "nothing"]
        words["course"], words["yaw_rate"] = (writer.word(places[n]) for n in (COURSE, YAW_RATE))
        words |= {
            "keeps": keep_lines(steps, writer),
            "state": state,
            "start": start_lines(steps, writer) if state else [],
            "units": course_units(catalog.signals),
            "half_turn": HALF_TURN,
            "coarser": TURNED_DIVISOR,
            "delay_parts": LATE_PARTS,
            "min_delay": MIN_COURSE_DELAY,
            "max_delay": MAX_COURSE_DELAY,
            "delay_ms": f"{1000 * float(SAMPLE_TIME_S) / LATE_PARTS:g}",
            "history": max(on_board.history_ticks for _, on_board in changed),
            "max_times": max(len(on_board.counted.times) for _, on_board in changed),
            "max_columns": max(len(s.computed) for _, s in changed) + len(AUXILIARY) + 1,
            "columns_bytes": MAX_COLUMNS // 8,
            "places": [place for on_board in sets for place in on_board.places],
            "firsts": [0, *accumulate(widths[:-1])],
        }
        writer.counts["nearest_64"] += 1
    words |= {"lines": [*writer.lines, *words.get("keeps", ())], "helpers": helper_texts(writer)}
    return words
