"""What divides a drive into several Gram rows, in SQL and for arrays: bands, blocks, row folds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.catalogue.course_change import OVER
from fleet_slip.catalogue.feature_catalogue import FeatureCatalogue
from fleet_slip.catalogue.feature_sets import FeatureSet

UNKNOWN_PART = "unknown"
"""Part of the rows whose regime is not known because a signal is absent."""

UNKNOWN = -1

BLOCK_FORMAT = "block %04d"
"""Names that sort as numbers do."""


@dataclass(frozen=True)
class Bands:
    """The bands of a signal or feature, or of its size: the least count of all but the first."""

    of: str
    absolute: bool
    bounds: tuple[int, ...]
    names: tuple[str, ...]

    @property
    def sql(self) -> str:
        """The SQL of a row's band; null where the signal is."""
        value = f"abs({self.of}::INTEGER)" if self.absolute else self.of
        return "(" + " + ".join(f"({value} >= {bound})::INTEGER" for bound in self.bounds) + ")"

    def __call__(self, counts: FloatArray) -> FloatArray:
        """Return the band of each row, shape (rows,); NaN where the count is."""
        size = np.abs(counts) if self.absolute else counts
        reached = np.searchsorted(np.array(self.bounds, dtype=np.float64), size, side="right")
        return np.where(np.isnan(counts), np.nan, reached)


@dataclass(frozen=True)
class Parts:
    """How the rows of a drive are divided: by at most one of bands, blocks, folds and times.

    Combined bands run with the last fastest. `times` are what columns change over, if several; each
    has all rows.
    """

    bands: tuple[Bands, ...] = ()
    block_ticks: int | None = None
    row_folds: int | None = None
    times: tuple[str, ...] = ()

    @classmethod
    def of_set(cls, known: FeatureCatalogue, one: FeatureSet) -> "Parts":
        """Return what divides the rows of a feature set."""
        bands = []
        for name in one.regimes:
            regime = known.regimes[name]
            scale = known.of(regime.of).exact_scale
            # Counts are whole, so that reaching a bound is reaching the next whole count.
            bounds = tuple(math.ceil(Fraction(bound) / scale) for bound in regime.bounds)
            bands.append(Bands(regime.of, regime.absolute, bounds, regime.bands))
        times = tuple(f"{time_s:f} s" for time_s in one.change_s)
        return cls(tuple(bands), one.block_ticks, one.row_folds, times if len(times) > 1 else ())

    def __bool__(self) -> bool:
        return bool(self.bands or self.block_ticks or self.row_folds or self.times)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the times, or of the combinations of bands."""
        if self.times:
            return self.times
        names = [""]
        for bands in self.bands:
            names = [f"{name}, {band}".removeprefix(", ") for name in names for band in bands.names]
        return tuple(names)

    @property
    def number_sql(self) -> str:
        """SQL of a row's part, a number from 0; null where it is not known."""
        if self.row_folds:
            return _row_fold_sql(self.row_folds)
        if self.block_ticks:
            return f"tick // {self.block_ticks}"
        if self.times:
            return OVER
        number = "0"
        for bands in self.bands:
            number = f"({number}) * {len(bands.names)} + {bands.sql}"
        return number

    def name_sql(self, number: str) -> str:
        """Return the SQL of a part's name, given that of its number."""
        if self.row_folds:
            return f"({number} + 1)::VARCHAR"
        if self.block_ticks:
            return f"printf('{BLOCK_FORMAT}', {number} + 1)"
        names = ", ".join(f"'{name}'" for name in self.names)
        return f"coalesce([{names}][{number} + 1], '{UNKNOWN_PART}')"

    def numbers(self, ticks: NDArray[Any], counts: Mapping[str, FloatArray]) -> IntArray:
        """Return each row's part, (rows,), or `UNKNOWN`; `columns` are what the bands are of."""
        if self.row_folds:
            raise ValueError("rows are dealt into folds by SQL alone")
        if self.block_ticks:
            return ticks.astype(np.int64) // self.block_ticks
        number: FloatArray = np.zeros(len(ticks))
        for bands in self.bands:
            number = number * len(bands.names) + bands(counts[bands.of])
        return np.where(np.isnan(number), UNKNOWN, number).astype(np.int64)

    def name(self, number: int) -> str | None:
        """Return the name of a part; None where rows are not divided."""
        if self.block_ticks:
            return BLOCK_FORMAT % (number + 1)
        if not (self.bands or self.times):
            return None
        return UNKNOWN_PART if number == UNKNOWN else self.names[number]


def _row_fold_sql(count: int) -> str:
    """Number the folds by MD5 of the drive and the 32-bit hash of Thomas Mueller of the tick."""
    value = "((md5_number_lower(drive_id) % 4294967296)::BIGINT + tick) % 4294967296"
    for _ in range(2):
        value = f"xor({value}, ({value}) >> 16) * 73244475 % 4294967296"
    return f"({value}) % {count}"
