"""Which drives and cars the Gram rows of a cohort are of."""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray
from fleet_slip.catalogue.sources import RECEIVED
from fleet_slip.grams.rows.rollup import FileDrives, Hashes, Places, join_places

AT_ONCE = 2**21
"""So many hashes of cars, most of them again and again, are looked through at once."""


@dataclass(frozen=True)
class Hashed:
    """Drives or cars whose hashes `parts` return when asked: `once` if each is there once."""

    parts: tuple[Callable[[], Hashes], ...]
    once: int | None = None

    @classmethod
    def of(cls, hashes: Hashes, *, once: bool = False) -> "Hashed":
        """Return hashes that are here."""
        return cls((lambda: hashes,), len(hashes) if once else None)

    @cached_property
    def number(self) -> int:
        """How many there are."""
        return len(_union([self])) if self.once is None else self.once

    def __add__(self, other: "Hashed") -> "Hashed":
        both = None if self.once is None or other.once is None else self.once + other.once
        return Hashed(self.parts + other.parts, both)


@dataclass(frozen=True)
class Members:
    """The drives of each Gram row, and their cars, by its signals, and the `received` drives."""

    drives: dict[str, Hashed] = field(default_factory=dict)
    vehicles: dict[str, Hashed] = field(default_factory=dict)
    received: dict[str, Hashed] = field(default_factory=dict)

    def add(self, signals: str, *new: Hashed | None) -> None:
        """Add drives, cars and received drives that are new to those with the same signals."""
        for known, more in zip(vars(self).values(), new, strict=False):
            if more is not None:
                known[signals] = known[signals] + more if signals in known else more

    def __add__(self, other: "Members") -> "Members":
        both = Members(*(dict(known) for known in vars(self).values()))
        for signals in other.vehicles:
            found = (known.get(signals) for known in vars(other).values())
            both.add(signals, *(hashed and Hashed(hashed.parts) for hashed in found))
        return both

    def drives_with(self, signals: Collection[str]) -> Hashes:
        """Return the hashes of the drives that have all of some signals, each once, sorted."""
        return _union([self.drives[kind] for kind in _kinds_with(self.drives, signals)])

    def by_file(self, signals: Collection[str]) -> tuple[dict[str, Places], Hashes]:
        """Return drives that have all of some signals: places in Gram files, and hashes of others.

        Of files whose rollups serve, no drive is read.
        """
        kinds = _kinds_with(self.drives, signals)
        places: dict[str, list[tuple[int, int]]] = defaultdict(list)
        others = []
        for part in (part for kind in sorted(kinds) for part in self.drives[kind].parts):
            if isinstance(part, FileDrives):
                places[part.rollup.path] += part.places
            else:
                others.append(part)
        joined = {path: join_places(places[path]) for path in sorted(places)}
        return joined, _union([Hashed(tuple(others))])

    def count_drives(self, kinds: Collection[str]) -> int:
        """Return the number of drives that have a Gram row of one of some sets of signals."""
        return _count(self.drives, frozenset(kinds))

    def count_received_with(self, signals: Collection[str]) -> int:
        """Return the number of drives without a log that have all of some signals."""
        return _count(self.received, _kinds_with(self.received, signals))

    @property
    def count_received(self) -> int:
        """Number of drives without a log."""
        return self.count_received_with(())

    def count_vehicles_with(self, signals: Collection[str]) -> int:
        """Return the number of cars that have all of some signals."""
        return _count(self.vehicles, _kinds_with(self.vehicles, signals))


def received_among(rows: pa.Table | pa.RecordBatch) -> BoolArray:
    """Return which Gram rows are of drives whose cars sent them, by the column `source`."""
    came = pc.fill_null(pc.equal(rows["source"].cast(pa.string()), RECEIVED), False)
    found: BoolArray = np.asarray(came.to_numpy(zero_copy_only=False), dtype=np.bool_)
    return found


def _kinds_with(hashed: Mapping[str, Hashed], signals: Collection[str]) -> frozenset[str]:
    return frozenset(names for names in hashed if set(signals) <= set(names.split(",")))


def _count(hashed: Mapping[str, Hashed], kinds: frozenset[str]) -> int:
    found = [hashed[names] for names in hashed if names in kinds]
    return found[0].number if len(found) == 1 else len(_union(found))


def _union(found: Sequence[Hashed]) -> Hashes:
    """Return the hashes, each once, sorted; hashes that repeat take no memory for long."""
    known, waiting, many = np.array([], dtype=np.uint64), list[Hashes](), 0
    for read in (part for one in found for part in one.parts):
        waiting.append(read())
        many += len(waiting[-1])
        if many > max(AT_ONCE, len(known)):
            known, waiting, many = _with_new(known, waiting), [], 0
    return _with_new(known, waiting) if waiting else known


def _with_new(known: Hashes, more: Sequence[Hashes]) -> Hashes:
    every = pa.array(np.concatenate(more))
    new = every.filter(pc.invert(pc.is_in(every, value_set=pa.array(known)))).to_numpy()
    together = np.sort(np.concatenate([known, new]))  # np.unique takes three times as long
    first = np.ones(len(together), dtype=np.bool_)
    first[1:] = together[1:] != together[:-1]
    return together[first]
