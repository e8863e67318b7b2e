"""Which Gram rows a car counts beside a model, and what their columns are computed by.

Those of the logged signals; and, if changes of the course taught the model, what teaches it again:
the changes of its columns, how late the receiver is, and what tells the offsets of the sensors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fleet_slip.catalogue.car_numbers import CALIBRATION, DELAY
from fleet_slip.catalogue.course_change import BESIDE, COURSE, MOST_LATE, YAW_RATE
from fleet_slip.catalogue.course_relation import COLUMNS
from fleet_slip.catalogue.definitions import plain_column
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.counted_columns import rows_of
from fleet_slip.columns.lowering import Lowering
from fleet_slip.errors import RefusedError
from fleet_slip.export.program import Input, Steps
from fleet_slip.grams.received.counted_sets import (
    MOST_SIGNALS,
    CountedSet,
    Range,
    counted_by_identity,
)
from fleet_slip.grams.rows.receiver_delay import delay_columns
from fleet_slip.models.manifest import Manifest
from fleet_slip.words import number_of


@dataclass(frozen=True)
class OnBoard:
    """A feature set as a car counts it.

    Attributes:
        of: the set.
        columns: of it that are counted.
        complete: whether rows that lack some of these, and tell nothing then, are left out.
    """

    of: CountedSet
    columns: tuple[str, ...]
    complete: bool = False

    @property
    def computed(self) -> tuple[str, ...]:
        """The columns that are computed at each tick; of changes, the others come from fixes."""
        beside = (*BESIDE, catalogue().label) if self.of.times else ()
        return tuple(name for name in self.columns if name not in beside)

    @property
    def kept_ticks(self) -> int:
        """Of how many ticks columns are kept: of a change, and of a fix that is late."""
        return max(self.of.times) + 1 + (MOST_LATE if self.of.in_time else 0)

    @property
    def ranges(self) -> list[Range]:
        """The ranges of the columns."""
        return self.of.ranges_of(self.columns)

    @property
    def places(self) -> list[int]:
        """Which columns of the set they are."""
        return [self.of.columns.index(name) for name in self.columns]


def sets_on_board(manifest: Manifest) -> tuple[OnBoard, ...]:
    """Return what a car counts that has a model, the logged signals first.

    Raises `QuestionError` if the model's feature set is defined otherwise now, and `RefusedError`
    for one that cars cannot count.
    """
    plain = _whole(PLAIN)
    if manifest.learned_from is None:
        return (plain,)
    name = features().name_of(manifest.trained_on.feature_set)
    counted = counted_by_identity().get(features().identity(name))
    if counted is None:
        raise RefusedError(f"cars cannot count the feature set {name}: it has too many columns.")
    known = features().calibrated
    wanted = {known[one].of if one in known else one for one in manifest.signals}
    wanted |= {*COLUMNS, *BESIDE, catalogue().label}
    columns = tuple(column for column in counted.columns if column in wanted)
    over_time = [name for name in columns if name in features().time_columns]
    unknown = [
        name
        for name in over_time
        if any(part.fact for part in features().time_columns[name].definition.parts)
    ]
    if unknown or len(columns) > MOST_SIGNALS:
        has = unknown[0] if unknown else number_of(len(columns), "column")
        raise RefusedError(
            f"{manifest.name} has {has}: cars count up to {MOST_SIGNALS} columns of a feature set, "
            "and none of what a car knows of itself. Leave that out: fleet-slip export NAME --to c"
        )
    delay = _counted(DELAY)
    telling = tuple(column for column in delay.columns if column in delay_columns())
    told = OnBoard(delay, telling, complete=True)
    return (plain, OnBoard(counted, columns), told, _whole(CALIBRATION))


def _whole(name: str) -> OnBoard:
    return OnBoard(_counted(name), _counted(name).columns)


def _counted(name: str) -> CountedSet:
    return counted_by_identity()[features().identity(name)]


def lower(sets: Sequence[OnBoard]) -> tuple[Steps, Mapping[str, int]]:
    """Return the steps of all columns, and the step of each by its name."""
    known, signals = features(), catalogue()
    used = {name for one in sets for name in one.of.signals}
    names = dict.fromkeys(name for one in sets for name in one.computed)
    if any(one.of.times for one in sets):
        names |= dict.fromkeys((COURSE, YAW_RATE))
    windows = {
        name: known.time_columns[name].definition for name in names if name in known.time_columns
    }
    single = {name: plain_column(name) for name in names if name not in windows}
    rows = rows_of(single | known.rows(names), windows)
    used &= {signal for row in rows.values() for signal in row.signals}
    inputs = tuple(
        Input(name, one.column, one.unit, one.scale, one.min_count, one.max_count)
        for name, one in signals.signals.items()
        if name in used
    )
    lowered = Lowering({one.name: place for place, one in enumerate(inputs)})
    places = {name: lowered.row(row) for name, row in rows.items()}
    places |= {name: lowered.column(one) for name, one in windows.items()}
    found = Steps(inputs, tuple(lowered.facts), tuple(lowered.numbers), tuple(lowered.steps))
    return found, places
