"""What to compute of a drive: columns of single rows, and columns that look back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

from fleet_slip.catalogue.course_change import COURSE, YAW_RATE
from fleet_slip.catalogue.definitions import Definition, limit_of, plain_column
from fleet_slip.catalogue.feature_catalogue import FeatureCatalogue
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.block_program import BlockProgram
from fleet_slip.columns.blocks.compile_plan import compile_plan
from fleet_slip.columns.counted_columns import CountedColumns, parts_of, rows_of


@dataclass(frozen=True)
class ColumnPlan:
    """What to compute of a drive: columns by `names`, of `rows` (one row each) and `windows`.

    `rows` has what is looked back on and tells parts; `also` of them come beside the columns.
    """

    names: tuple[str, ...]
    rows: Mapping[str, Definition]
    windows: Mapping[str, Definition]
    also: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        features: Mapping[str, Definition],
        windows: Mapping[str, Definition],
        also: Sequence[str] = (),
    ) -> "ColumnPlan":
        """Plan columns by name: of `features`, of `windows`, or logged; `also` are beside them.

        Raises `DataError` for a feature that is defined in two ways.
        """
        rows = {
            name: features.get(name, plain_column(name))
            for name in (*names, *also)
            if name not in windows
        }
        return cls(tuple(names), rows_of(rows, windows), dict(windows), tuple(also))

    @classmethod
    def of_set(cls, known: FeatureCatalogue, name: str) -> "ColumnPlan":
        """Plan the columns of a feature set, the label last; of changes, what makes it."""
        one = known.feature_set(name)
        divided_by = [known.regimes[regime].of for regime in one.regimes]
        features = known.rows((*one.features, *divided_by))
        inputs = (*one.signals, *one.features, *one.windows)
        columns = (*inputs, COURSE, YAW_RATE) if one.change_ticks else one.columns
        return cls.of(columns, features, known.definitions(name), divided_by)

    @property
    def signals(self) -> tuple[str, ...]:
        """The logged signals that are needed, in catalogue order."""
        used = {name for row in self.rows.values() for name in row.signals}
        return tuple(name for name in catalogue().signals if name in used)

    @property
    def facts(self) -> tuple[str, ...]:
        """The drive columns that are needed."""
        parts = [part for one in self.windows.values() for part in parts_of(one)]
        return tuple(dict.fromkeys(part.fact.name for part in parts if part.fact))

    @property
    def numbers(self) -> tuple[str, ...]:
        """What the drives of a car must have told of it, or running means stand for."""
        found = (one.number.name for one in self.windows.values() if one.number)
        return tuple(dict.fromkeys(found))

    @property
    def limits(self) -> tuple[int, ...]:
        """The largest size that each column can have."""
        return tuple(
            limit_of(self.windows[name].bits)
            if name in self.windows
            else limit_of(self.rows[name].of_bits) + (not self.rows[name].sql)
            for name in self.names
        )

    @cached_property
    def program(self) -> BlockProgram:
        """The program that computes the columns, one for equal plans. Raises `QuestionError`."""
        return _program(
            self.names, tuple(self.rows.items()), tuple(self.windows.items()), self.also
        )


@lru_cache(maxsize=64)
def _program(
    names: tuple[str, ...],
    rows: tuple[tuple[str, Definition], ...],
    windows: tuple[tuple[str, Definition], ...],
    also: tuple[str, ...],
) -> BlockProgram:
    return compile_plan(CountedColumns.of(dict(rows), dict(windows)), names, also)
