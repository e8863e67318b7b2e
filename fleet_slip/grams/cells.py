"""Which drives and cars the Gram rows of a cohort are of."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.base import BoolArray
from fleet_slip.catalogue.facts import RECEIVED
from fleet_slip.grams.gram_rows import Hashes


class Hashed:
    """Hashes of drives or cars, gathered batch by batch; one may come again and again."""

    def __init__(self, *parts: Hashes) -> None:
        """Take what was read."""
        self.parts = list(parts)

    def each(self) -> Hashes:
        """Return the hash of each, once, sorted."""
        if len(self.parts) != 1:
            self.parts = [np.concatenate([*self.parts, np.array([], dtype=np.uint64)])]
        self.parts = [np.unique(self.parts[0])]
        return self.parts[0]


@dataclass(frozen=True)
class Members:
    """The drives of each Gram row, and their cars, by its signals, and the `received` drives."""

    drives: dict[str, Hashed] = field(default_factory=dict)
    vehicles: dict[str, Hashed] = field(default_factory=dict)
    received: dict[str, Hashed] = field(default_factory=dict)

    def add(self, signals: str, *new: Hashes) -> None:
        """Add drives, cars and received drives to those with the same signals."""
        for known, more in zip(vars(self).values(), new, strict=False):
            known.setdefault(signals, Hashed()).parts.append(more)

    def __add__(self, other: "Members") -> "Members":
        both = Members()
        for one in (self, other):
            for known, mine in zip(vars(both).values(), vars(one).values(), strict=True):
                for signals, hashed in mine.items():
                    known.setdefault(signals, Hashed()).parts.extend(hashed.parts)
        return both

    def drives_with(self, signals: Collection[str]) -> Hashes:
        """Return the hashes of the drives that have all of some signals, each once, sorted."""
        return _union([self.drives[kind] for kind in _kinds_with(self.drives, signals)])

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


def _count(hashed: Mapping[str, Hashed], kinds: Collection[str]) -> int:
    return len(_union([hashed[names] for names in hashed if names in kinds]))


def _union(found: Sequence[Hashed]) -> Hashes:
    """Return the hashes, each once, sorted."""
    each = [one.each() for one in found]
    return each[0] if len(each) == 1 else Hashed(*each).each()
