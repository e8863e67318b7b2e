"""What to compute of a drive: columns of single rows, and columns that look back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.course_change import COURSE, YAW_RATE
from fleet_slip.catalogue.definitions import Definition, features_behind, limit_of
from fleet_slip.catalogue.features import FeatureCatalogue
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.block_program import BlockProgram
from fleet_slip.columns.blocks.compile_plan import compile_plan
from fleet_slip.columns.blocks.row_code import RowColumn
from fleet_slip.errors import DataError


@dataclass(frozen=True)
class ColumnPlan:
    """What to compute of a drive.

    Attributes:
        names: the columns, in order.
        rows: the columns of one row that are asked for, looked back on, or tell a row's part.
        windows: the columns over time.
        also: of `rows`, those that are computed beside the columns.
    """

    names: tuple[str, ...]
    rows: Mapping[str, RowColumn]
    windows: Mapping[str, Definition]
    also: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        features: Mapping[str, RowColumn],
        windows: Mapping[str, Definition],
        also: Sequence[str] = (),
    ) -> "ColumnPlan":
        """Plan columns by name: of `features`, of `windows`, or else logged signals.

        `also` are columns of one row that are computed beside them. Raises `DataError` if two of
        them define the same feature differently.
        """
        rows: dict[str, RowColumn] = {}
        for name in (*names, *also):
            if name not in windows:
                rows[name] = features.get(name, RowColumn(name))
        features_behind(windows)
        for one in (part for window in windows.values() for part in window.parts):
            row = RowColumn(one.of)
            if one.sql:
                row = RowColumn(one.of, parse(one.sql), limit_of(one.of_bits))
            if rows.setdefault(one.of, row) != row:
                raise DataError(f"the feature {one.of} is defined in two ways.")
        return cls(tuple(names), rows, dict(windows), tuple(also))

    @classmethod
    def of_set(cls, known: FeatureCatalogue, name: str) -> "ColumnPlan":
        """Plan the columns of a feature set, the label last; of changes, what makes it."""
        one = known.feature_set(name)
        divided_by = [known.regimes[regime].of for regime in one.regimes]
        features = {
            f: RowColumn(f, parse(known.features[f].sql), known.features[f].limit)
            for f in (*one.features, *divided_by)
            if f in known.features
        }
        columns = (*one.inputs, COURSE, YAW_RATE) if one.change_ticks else one.columns
        return cls.of(columns, features, known.definitions(name), divided_by)

    @property
    def signals(self) -> tuple[str, ...]:
        """The logged signals that are needed, in catalogue order."""
        used = {name for row in self.rows.values() for name in row.inputs}
        return tuple(name for name in catalogue().signals if name in used)

    @property
    def facts(self) -> tuple[str, ...]:
        """The drive columns that are needed."""
        return tuple(dict.fromkeys(w.fact.name for w in self.windows.values() if w.fact))

    @property
    def limits(self) -> tuple[int, ...]:
        """The largest size that each column can have."""
        return tuple(
            limit_of(self.windows[name].bits)
            if name in self.windows
            else self.rows[name].limit + (self.rows[name].arithmetic is None)
            for name in self.names
        )

    @cached_property
    def program(self) -> BlockProgram:
        """The program that computes the columns; equal plans have the same.

        Raises `QuestionError` for a feature that divides by a number that is not positive.
        """
        return _program(
            self.names, tuple(self.rows.items()), tuple(self.windows.items()), self.also
        )


@lru_cache(maxsize=64)
def _program(
    names: tuple[str, ...],
    rows: tuple[tuple[str, RowColumn], ...],
    windows: tuple[tuple[str, Definition], ...],
    also: tuple[str, ...],
) -> BlockProgram:
    return compile_plan(names, dict(rows), dict(windows), also)
