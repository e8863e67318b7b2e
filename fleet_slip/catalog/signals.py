"""The signal catalog `configs/signals.toml` as types: scales, ranges, roles, Arrow schema."""

from collections import Counter
from decimal import Decimal
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Final, Literal

from pydantic import Field, StringConstraints, model_validator

from fleet_slip.config import Config, load_config
from fleet_slip.errors import QuestionError
from fleet_slip.resources import Configs

if TYPE_CHECKING:
    import pyarrow as pa

COUNT_MAX = 2**15 - 1
"""Largest count. The range is symmetric, so that mirroring a drive never overflows."""

HALF_TURN = COUNT_MAX + 1
"""Counts of half a turn, of a signal that is a whole turn."""

SAMPLE_TIME_S = Fraction(1, 100)
"""Time between two rows of a drive, in s: the paper's 0.01 s."""

IDENTIFIER_PATTERN = r"^[a-z][a-z0-9_]{0,40}$"

Identifier = Annotated[str, StringConstraints(pattern=IDENTIFIER_PATTERN)]
"""A name that is safe in SQL without quotes."""


_SYMBOL = r"(?:m|s|kg|rad|N|Pa|W|K|A|V)(?:\^[2-9])?"

SIUnit = Annotated[str, StringConstraints(pattern=rf"^(?:1|{_SYMBOL}(?:[*/]{_SYMBOL})*)$")]
"""A product or quotient of coherent SI units without prefixes, such as m/s^2; 1 for a number. A
pattern, because a units library takes half a second to start and every command needs it."""


class Scaled(Config):
    """A quantity in counts: `physical = scale * count`."""

    scale: Decimal = Field(gt=0)

    @property
    def exact_scale(self) -> Fraction:
        """Physical value of one count, exactly."""
        return Fraction(self.scale)


class Signal(Scaled):
    """One signal."""

    unit: SIUnit
    column: Identifier
    min: Decimal
    max: Decimal
    role: Literal["input", "extra", "label", "truth"]
    stepwise: bool = False
    """True if it changes in steps, such as a gear: resampling holds the previous value."""
    cyclic: bool = False
    """True for an angle of 65,536 counts per turn, so that int16 wraps."""
    description: str = Field(min_length=1)

    @model_validator(mode="after")
    def _range_fits_counts(self) -> "Signal":
        if self.min >= self.max:
            raise ValueError(f"min {self.min} is not below max {self.max}")
        if self.cyclic and not -self.min == self.max == HALF_TURN * self.scale:
            raise ValueError(f"cyclic: the range must be from -{HALF_TURN} to {HALF_TURN} counts")
        largest = max(abs(self.min), abs(self.max)) / self.scale
        if largest > COUNT_MAX and not self.cyclic:
            raise ValueError(f"the range needs counts up to {largest:f}, int16 ends at {COUNT_MAX}")
        return self

    @property
    def min_count(self) -> int:
        """Smallest valid count."""
        return -int(-self.min / self.scale)

    @property
    def max_count(self) -> int:
        """Largest valid count."""
        return COUNT_MAX if self.cyclic else int(self.max / self.scale)


# Columns of drives, the values of their column `source`, and the drives that may train a model.

SCENARIO: Final = "scenario"
"""Drives for evaluation alone: no model is trained on them."""

MEASURED: Final = "measured"
"""Drives from logs of real cars."""

RECEIVED: Final = "received"
"""Drives whose cars sent Gram rows and no log."""

RECEIVED_FILES: Final = "received/"
"""Prefix of the column `file` of Gram rows without a log file; a digest follows."""

RECEIVER: Final = "receiver"
"""Drive column with the type of the satellite receiver."""

LONGEST_PAUSE_S: Final = 600
"""Longest pause within a trip, in s. Road, load and tyre temperature may change in longer ones."""

ALL_DRIVES: Final = "true"
TRAINING_DRIVES: Final = f"source <> '{SCENARIO}'"

_SQL_TYPES = {
    "string": "VARCHAR",
    "double": "DOUBLE",
    "integer": "BIGINT",
    "timestamp": "TIMESTAMPTZ",
}
"""DuckDB's types."""


class DriveColumn(Config):
    """One column of metadata, the same in every row of a drive."""

    type: Literal["string", "double", "integer", "timestamp"]
    optional: bool = False
    """True if a file has the column only if one of its drives has a value."""
    description: str = Field(min_length=1)

    @property
    def arrow_type(self) -> "pa.DataType":
        """Arrow type of the column."""
        import pyarrow as pa  # noqa: PLC0415 - most commands need no schema

        return {
            "string": pa.string(),
            "double": pa.float64(),
            "integer": pa.int64(),
            "timestamp": pa.timestamp("us", tz="UTC"),
        }[self.type]

    @property
    def sql_type(self) -> str:
        """DuckDB's type of the column."""
        return _SQL_TYPES[self.type]


NEEDED_DRIVE_COLUMNS = (
    *("drive_id", "trip_id", "vehicle_id", "vehicle_model", "source", "campaign", "track"),
    *("mass_kg", "adhesion", "speed_factor", "started_at", "duration_s", "rows", "saturated"),
)
"""Drive columns that the shipped SQL requires."""


class SignalCatalog(Config):
    """All signals and drive columns, in the file's order."""

    signals: dict[Identifier, Signal]
    drive: dict[Identifier, DriveColumn]

    @model_validator(mode="after")
    def _consistent(self) -> "SignalCatalog":
        labels = [name for name, signal in self.signals.items() if signal.role == "label"]
        if len(labels) != 1:
            raise ValueError(f"exactly one signal must have the role 'label', not {labels}")
        if missing := [name for name in NEEDED_DRIVE_COLUMNS if name not in self.drive]:
            raise ValueError(
                f"the drive columns {', '.join(missing)} are missing. Copy them from the shipped "
                "catalog, configs/signals.toml"
            )
        if twice := sorted(name for name, number in Counter(self.names).items() if number > 1):
            raise ValueError(f"names must differ: {', '.join(twice)}")
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns of logs, as counts and in SI units."""
        columns = (signal.column for signal in self.signals.values())
        return (*self.signals, *columns, *self.drive, "day", "tick", "time_s")

    def __getitem__(self, name: str) -> Signal:
        """Return a signal by name. Raises `QuestionError` for an unknown one."""
        try:
            return self.signals[name]
        except KeyError:
            names = ", ".join(self.signals)
            raise QuestionError(f"unknown signal {name!r}. Known signals: {names}.") from None

    @cached_property
    def label(self) -> str:
        """Name of the signal that is estimated."""
        return next(name for name, signal in self.signals.items() if signal.role == "label")

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Names of the signals that a model may use, in catalog order."""
        return tuple(name for name, signal in self.signals.items() if signal.role == "input")

    @cached_property
    def extras(self) -> tuple[str, ...]:
        """Names of the signals that only some cars log, in catalog order.

        A log file has their columns only if one of its drives has them.
        """
        return tuple(name for name, signal in self.signals.items() if signal.role == "extra")

    @cached_property
    def optional(self) -> tuple[str, ...]:
        """Names of the columns that a log file has only if one of its drives has a value."""
        return (*(name for name, column in self.drive.items() if column.optional), *self.extras)

    @cached_property
    def feature_inputs(self) -> tuple[str, ...]:
        """Names of the signals that a feature may be computed from, in catalog order."""
        return tuple(name for name in self.signals if name in {*self.inputs, *self.extras})

    @cached_property
    def gram_signals(self) -> tuple[str, ...]:
        """Names of the signals of a Gram row: the inputs, then the label."""
        return (*self.inputs, self.label)

    @property
    def stored_columns(self) -> tuple[str, ...]:
        """Names of the columns of the table `logs` that depend on the catalog."""
        return (*self.drive, *self.signals)

    def null_sql(self, name: str) -> str:
        """Return the SQL of a stored column without a value."""
        kind = "SMALLINT" if name in self.signals else self.drive[name].sql_type
        return f"NULL::{kind} AS {name}"

    @cached_property
    def drive_schema(self) -> "pa.Schema":
        """Arrow schema of a drive's metadata."""
        import pyarrow as pa  # noqa: PLC0415

        return pa.schema([(name, column.arrow_type) for name, column in self.drive.items()])

    @cached_property
    def log_schema(self) -> "pa.Schema":
        """Arrow schema of the table `logs`: day, drive metadata, tick, then the counts."""
        import pyarrow as pa  # noqa: PLC0415

        return pa.schema(
            [
                ("day", pa.date32()),
                *self.drive_schema,
                ("tick", pa.int32()),
                *((name, pa.int16()) for name in self.signals),
            ]
        )


def load_signals(configs: Configs) -> SignalCatalog:
    """Return the signal catalog `signals.toml` of a folder of configs. Raises `ConfigError`."""
    return load_config(configs.file("signals.toml"), SignalCatalog)
