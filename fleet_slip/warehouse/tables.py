"""The warehouse of one data root: which tables it holds and how they are encoded."""

from dataclasses import dataclass
from functools import cached_property

import pyarrow as pa

from fleet_slip.catalogue.course_change import COURSE_LATE
from fleet_slip.catalogue.signals import SignalCatalogue, catalogue
from fleet_slip.delta import Encoding, Table
from fleet_slip.delta.schema import SCALE
from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder

QUARANTINE_SCHEMA = pa.schema(
    [
        ("file", pa.string()),
        ("row", pa.int64()),
        ("drive_id", pa.string()),
        ("vehicle_id", pa.string()),
        ("reason", pa.string()),
        ("signal", pa.string()),
        ("value", pa.string()),
    ]
)
"""One row per rejected row of a file. `row` counts its rows of data from 1; `drive_id` is the drive
that it belongs to and `vehicle_id` its car, null if that is what is wrong; `signal` is the signal
or metadata concerned, or `time`; `value` is what stood there, as text."""

SIGNED = "signed"
"""Column of `grams` that releases up to 0.3 kept signatures of cars in; no view has it."""


@dataclass(frozen=True)
class Warehouse:
    """The tables below a data root. Making one touches nothing below it."""

    root: Folder

    @property
    def catalogue(self) -> SignalCatalogue:
        """The signal catalogue of the logs."""
        return catalogue()

    def require(self) -> None:
        """Raise `StorageError` if there is no data root: a wrong path is not an empty warehouse."""
        if not self.root.exists():
            raise StorageError(
                f"{self.root}: there is no data root. Make one with: fleet-slip run, or fleet-slip "
                "ingest; or choose another with --root."
            )

    @cached_property
    def logs(self) -> Table:
        """Counts at 100 Hz, partitioned by day; a file holds whole drives."""
        signals = self.catalogue
        return Table(
            folder=self.root / "logs",
            schema=stored_schema(signals),
            encoding=Encoding(
                dictionary=tuple(signals.drive),
                delta_packed=("tick", *signals.signals),
            ),
            partition_by=("day",),
            description="Logs of drives at 100 Hz as integer counts: physical = scale * count",
            optional=signals.optional,
        )

    @cached_property
    def grams(self) -> Table:
        """Gram rows of drives, by feature set: n, sums and sums of products of counts."""
        return Table(
            folder=self.root / "grams",
            schema=pa.schema(
                [
                    *gram_schema(self.catalogue),
                    (SIGNED, pa.binary()),
                    (COURSE_LATE, pa.int64()),
                ]
            ),
            encoding=Encoding(
                dictionary=("feature_set", "file", "part", "signals", *self.catalogue.drive),
                # A seventh smaller, and twice as fast to write and read, as zstd alone.
                delta_packed=("sums.list.element", "products.list.element"),
                compression="zstd",
            ),
            description="Gram rows: exact sums and sums of products of counts, one a drive",
            optional=(SIGNED, COURSE_LATE),
        )

    def computed_schema(self, *, in_time: bool) -> pa.Schema:
        """Return the schema of computed Gram rows, with delays corrected in them or not."""
        usual = self.grams.usual_schema
        return usual.append(self.grams.schema.field(COURSE_LATE)) if in_time else usual

    @cached_property
    def quarantine(self) -> Table:
        """Rows of measured logs that were refused, with the reason."""
        return Table(
            folder=self.root / "quarantine",
            schema=QUARANTINE_SCHEMA,
            encoding=Encoding(
                dictionary=("file", "vehicle_id", "reason", "signal"), compression="zstd"
            ),
            description="Rows of measured logs that were refused, with the reason",
        )

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables."""
        return (self.logs, self.grams, self.quarantine)


def stored_schema(signals: SignalCatalogue) -> pa.Schema:
    """Return the schema of the table `logs`, with each signal's scale in its field's metadata."""
    return pa.schema(
        [
            field.with_metadata({SCALE: str(signals[field.name].scale)})
            if field.name in signals.signals
            else field
            for field in signals.log_schema
        ]
    )


def gram_schema(signals: SignalCatalogue) -> pa.Schema:
    """Return the Arrow schema of the table `grams`.

    `part` is null where a Gram row is of a whole drive, else which of its rows it is of. `clipped`
    is how many values of the features were out of the range of int16.
    `signals` names the signals that the drive has, separated by commas, in the order of `sums`;
    `products` is the packed lower triangle, row by row: (0,0), (1,0), (1,1), (2,0), ...
    """
    return pa.schema(
        [
            ("feature_set", pa.string()),
            ("file", pa.string()),
            ("day", pa.date32()),
            *signals.drive_schema,
            ("part", pa.string()),
            ("signals", pa.string()),
            ("n", pa.int64()),
            ("clipped", pa.int64()),
            ("sums", pa.list_(pa.int64())),
            ("products", pa.list_(pa.int64())),
        ]
    )
