"""The warehouse of one data root: which tables it holds and how they are encoded."""

import json
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from fleet_slip.catalog.catalog import Catalog, FirstStageModel, load_catalog
from fleet_slip.catalog.course import COURSE_LATE
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import StorageError
from fleet_slip.resources import SHIPPED_CONFIGS, Configs
from fleet_slip.storage.data_files import Encoding
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.local import data_root
from fleet_slip.storage.table import SCALE, Table

if TYPE_CHECKING:
    import pyarrow as pa


LINES = "lines"
"""Folder of the first-stage models of a data root."""


class StackedModels:
    """The first-stage models of a data root: a folder of documents for each, by its digest."""

    def __init__(self, root: Folder) -> None:
        self.root = root
        self._models: dict[str, FirstStageModel] = {}

    def digests(self) -> list[str]:
        """Return the digests of all models, sorted."""
        return sorted((self.root / LINES).names())

    def find(self, digest: str) -> FirstStageModel | None:
        """Return a model by its digest; None if there is none. Raises `StorageError`."""
        if digest not in self._models:
            documents = DocumentFolder(self.root, f"{LINES}/{digest}")
            if 1 not in documents.numbers():
                return None
            try:
                content = documents.read(1).content["line"]
                model = FirstStageModel.model_validate_json(json.dumps(content))
            except (ValidationError, KeyError):
                model = None
            if model is None or model.digest != digest:
                file = documents.file(1)
                raise StorageError(
                    f"{file}: no first-stage model of that checksum. Restore the folder."
                )
            self._models[digest] = model
        return self._models[digest]

    def keep(self, model: FirstStageModel) -> None:
        """Write a model durably, unless it exists."""
        documents = DocumentFolder(self.root, f"{LINES}/{model.digest}")
        documents.create(1, {"line": model.model_dump(mode="json")})

    def clear(self) -> None:
        """Forget the models that were read; they are read again when needed."""
        self._models.clear()


@dataclass(frozen=True)
class Warehouse:
    """The tables and the catalog of a data root. Creating one reads and writes nothing.

    Attributes
    ----------
    root
        Folder of the data root.
    configs
        Configuration files that the catalog is loaded from.
    """

    root: Folder
    configs: Configs = SHIPPED_CONFIGS

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without tables; with the catalog, unless it is the shipped one.

        A worker elsewhere need not have the folder of configs.
        """
        if self.configs == SHIPPED_CONFIGS:
            return Warehouse, (self.root,)
        return _unpickle, (self.root, self.configs, self.catalog)

    def close(self) -> None:
        """Release the tables, and the first-stage models that were read."""
        self.stacked_models.clear()
        for table in ("logs", "grams", "quarantine"):
            self.__dict__.pop(table, None)

    @cached_property
    def catalog(self) -> Catalog:
        """Signals, features, feature sets and first-stage models. Raises `ConfigError`."""
        return replace(load_catalog(self.configs), first_stage_models=self.stacked_models)

    @cached_property
    def stacked_models(self) -> StackedModels:
        """The first-stage models of this data root."""
        return StackedModels(self.root)

    def require(self) -> None:
        """Raise `StorageError` if there is no data root: a wrong path is not an empty warehouse."""
        if not self.root.exists():
            raise StorageError(
                f"{self.root}: no data root. Create one with fleet-slip learn or ingest (own "
                "logs) or fleet-slip run (simulated), or choose another: --root."
            )

    @cached_property
    def logs(self) -> Table:
        """Counts at 100 Hz, partitioned by day; a file holds whole drives."""
        signals = self.catalog.signals
        return Table(
            folder=self.root / "logs",
            schema=stored_schema(signals),
            encoding=Encoding(
                dictionary=tuple(signals.drive), delta_packed=("tick", *signals.signals)
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
            schema=gram_schema(self.catalog.signals),
            encoding=Encoding(
                dictionary=("feature_set", "file", "part", "signals", *self.catalog.signals.drive),
                # A seventh smaller, and twice as fast to write and read, as zstd alone.
                delta_packed=("sums.list.element", "products.list.element"),
                compression="zstd",
            ),
            description="Gram rows: exact sums and sums of products of counts, one a drive",
            optional=(COURSE_LATE,),
        )

    def computed_schema(self, *, in_time: bool) -> "pa.Schema":
        """Return the schema of computed Gram rows, with delays corrected in them or not."""
        usual = self.grams.usual_schema
        return usual.append(self.grams.schema.field(COURSE_LATE)) if in_time else usual

    @cached_property
    def quarantine(self) -> Table:
        """Rows of measured logs that were refused, with the reason."""
        return Table(
            folder=self.root / "quarantine",
            schema=quarantine_schema(),
            encoding=Encoding(
                dictionary=("file", "vehicle_id", "reason", "signal"), compression="zstd"
            ),
            description="Rows of measured logs that were refused, with the reason",
        )

    def feature_sets(self) -> tuple[str, ...]:
        """Return the feature sets that Gram rows can be of, with those of first-stage models."""
        catalog = self.catalog
        digests = self.stacked_models.digests() if catalog.stacked_sets else []
        models = [model for digest in digests if (model := self.stacked_models.find(digest))]
        stacked = [
            f"{name}_{model.digest}"
            for name, estimate in catalog.stacked_sets.items()
            for model in models
            if model.estimate == estimate and model.scale == catalog.estimates[estimate].scale
        ]
        plain = (name for name in catalog.sets if name not in catalog.stacked_sets)
        return (PLAIN, *plain, *stacked)

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables."""
        return (self.logs, self.grams, self.quarantine)


def _unpickle(root: Folder, configs: Configs, catalog: Catalog) -> Warehouse:
    warehouse = Warehouse(root, configs)
    models = warehouse.stacked_models
    warehouse.__dict__["catalog"] = replace(catalog, first_stage_models=models)
    return warehouse


ROOT_VARIABLE, CONFIG_VARIABLE = "FLEET_SLIP_ROOT", "FLEET_SLIP_CONFIG"
"""Environment variables with the defaults of `root` and `config` of `open_warehouse`."""


def open_warehouse(
    root: Folder | Path | str | None = None, config: Path | str | None = None
) -> Warehouse:
    """Return the warehouse that arguments, else the environment, else the defaults name.

    `fleet_slip.open` and the command line call this; no other function reads the environment.
    Raises `StorageError` for an unusable root and `ConfigError` for an unusable folder of configs.
    """
    chosen = config or os.environ.get(CONFIG_VARIABLE)
    configs = Configs(Path(chosen)) if chosen else SHIPPED_CONFIGS
    return Warehouse(data_root(root or os.environ.get(ROOT_VARIABLE)), configs)


# Schemas of the tables. pyarrow is imported when one is needed: it takes a tenth of a second.


def quarantine_schema() -> "pa.Schema":
    """Return the Arrow schema of the table `quarantine`: one row for each rejected row of a file.

    `row` counts the file's rows of data from 1. `drive_id` and `vehicle_id` are null if they are at
    fault. `signal` is the signal or metadata at fault, or `time`; `value` is its text in the file.
    """
    import pyarrow as pa

    texts = ("drive_id", "vehicle_id", "reason", "signal", "value")
    return pa.schema(
        [("file", pa.string()), ("row", pa.int64()), *((name, pa.string()) for name in texts)]
    )


def stored_schema(signals: SignalCatalog) -> "pa.Schema":
    """Return the schema of the table `logs`, with scale and unit of each signal's field."""
    import pyarrow as pa

    return pa.schema(
        [
            field.with_metadata(
                {SCALE: str(signals[field.name].scale), "unit": signals[field.name].unit}
            )
            if field.name in signals.signals
            else field
            for field in signals.log_schema
        ]
    )


def gram_schema(signals: SignalCatalog) -> "pa.Schema":
    """Return the Arrow schema of the table `grams`: one Gram row a row.

    `part` is the block of rows that it covers, null for a whole drive. `clipped` counts values of
    features beyond their range. `signals` lists the drive's signals, comma-separated, in the order
    of `sums`. `products` is the lower triangle row by row: (0,0), (1,0), (1,1), (2,0), ...
    `course_late` is the delay of the course in quarter ticks.
    """
    import pyarrow as pa

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
            (COURSE_LATE, pa.int64()),
        ]
    )
