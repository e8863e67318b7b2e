"""The feature sets that cars can count: their columns, the ranges of these, and their definition.

The definition of a set is the first 8 bytes of the SHA-256 of the canonical JSON of its identity
and of name, scale and range of each signal that it is made of.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.course_change import (
    BESIDE,
    COARSER,
    COURSE,
    STRAIGHT,
    TURNED,
    YAW_RATE,
    course_units,
)
from fleet_slip.catalogue.definitions import limit_of
from fleet_slip.catalogue.feature_sets import PLAIN, FeatureSet
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.row_features import Feature
from fleet_slip.catalogue.signals import COUNT_MAX, Signal, catalogue
from fleet_slip.grams.rows.drive_parts import Parts

Range = tuple[int, int]

MOST_ROWS = 2**31 - 1
"""Rows of a drive: 248 days. No sum of so many products of int16 counts reaches 2^61."""

MOST_SIGNALS = 32
"""That a car counts of a set."""

MOST_COLUMNS = 512
"""Of a feature set that cars count: there is a bit for each."""


@dataclass(frozen=True)
class CountedSet:
    """A feature set that cars can count.

    Attributes:
        name, identity: of the set.
        columns: of its Gram rows, in order.
        ranges: the smallest and the largest count of each.
        signals: what a car must know to count it, in catalogue order.
        times: over how many ticks columns change; none where they stand for themselves.
        parts: what those parts of a drive are called; None alone where it is not divided.
        in_time: whether the course is moved by its delay.
        definition: what C code calls it.
    """

    name: str
    identity: str
    columns: tuple[str, ...]
    ranges: tuple[Range, ...]
    signals: tuple[str, ...]
    times: tuple[int, ...]
    parts: tuple[str | None, ...]
    in_time: bool
    definition: int

    @property
    def key(self) -> str:
        """What a table of Gram rows calls it: its name, and what its columns mean."""
        return f"{self.name}:{self.definition:016x}"

    def ranges_of(self, columns: Sequence[str]) -> list[Range]:
        """Return the ranges of some columns."""
        known = dict(zip(self.columns, self.ranges, strict=True))
        return [known[name] for name in columns]


@cache
def counted_sets() -> dict[int, CountedSet]:
    """Return the sets by their definitions, the logged signals first."""
    known = features()
    found = [_counted(name) for name in (PLAIN, *known.sets) if _can_be(known.feature_set(name))]
    return {one.definition: one for one in found}


@cache
def counted_by_identity() -> dict[str, CountedSet]:
    """Return the sets by what their Gram rows carry."""
    return {one.identity: one for one in counted_sets().values()}


def _can_be(one: FeatureSet) -> bool:
    divided = one.regimes or one.block_ticks or one.row_folds or one.lagged
    return not divided and len(one.columns) <= MOST_COLUMNS


def _counted(name: str) -> CountedSet:
    one, known = features().feature_set(name), catalogue()
    used = {*one.signals, known.label}
    if one.change_ticks:
        used = {*one.signals, COURSE, YAW_RATE}
    used |= {signal for f in one.features for signal in features().features[f].inputs}
    used |= {signal for d in features().definitions(name).values() for signal in d.signals}
    signals = tuple(signal for signal in known.signals if signal in used)
    return CountedSet(
        name,
        features().identity(name),
        one.columns,
        tuple(_range(column, one.change_ticks) for column in one.columns),
        signals,
        one.change_ticks,
        Parts.of_set(features(), one).times or (None,),
        one.in_time,
        _definition_of(signals, None if name == PLAIN else features().identity(name)),
    )


def _definition_of(signals: Sequence[str], identity: str | None) -> int:
    known = [
        [name, f"{s.scale:f}", s.min_count, s.max_count]
        for name in signals
        for s in [catalogue()[name]]
    ]
    content = canonical_json(known if identity is None else [identity, known])
    return int.from_bytes(bytes.fromhex(sha256_of(content)[:16]), "little")


def _range(column: str, times: Sequence[int]) -> Range:
    if times and column in (*BESIDE, catalogue().label):
        return _range_beside(column, max(times))
    of = catalogue()[column] if column == catalogue().label else features().of(column)
    if isinstance(of, Signal):
        least, most = of.min_count, of.max_count
    else:
        most = limit_of(of.bits if isinstance(of, Feature) else of.definition.bits)
        least = -most
    return (least - most, most - least) if times else (least, most)


def _range_beside(column: str, ticks: int) -> Range:
    if column == STRAIGHT:
        return 0, 1
    units = course_units()
    most = units.largest // units.divisor + 1
    if column == TURNED:
        most = 2 * ticks * COUNT_MAX // COARSER + 1
    return -most, most
