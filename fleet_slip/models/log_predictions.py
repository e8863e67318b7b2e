"""Predictions of a published model for log files, as a table beside the reference."""

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record, pluralize, require_extra
from fleet_slip.errors import AlarmError, DataError, InputError, MissingColumnError, UsageError
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.compute import counts_of
from fleet_slip.ingest.logs import log_table
from fleet_slip.ingest.mapping import Mapping
from fleet_slip.ingest.measured_log import open_measured
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.score import calibrated_cars, label_of
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.drive_signals import TICKS_PER_S
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse

FORMATS = (".parquet", ".csv", ".mf4")
"""Suffixes of the output."""

ESTIMATE, REFERENCE = "sideslip_estimate_deg", "sideslip_reference_deg"


@dataclass(frozen=True)
class PredictedDrive(Record):
    """Predictions of a drive: `table` has `drive_id`, `time_s`, estimate and reference in deg.

    `errors_deg` are those of the rows that have both.
    """

    DOCUMENT = "drive_id vehicle_id rows rows_estimated rmse_deg"

    drive_id: str
    vehicle_id: str
    table: pa.Table
    rows_estimated: int
    errors_deg: FloatArray

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.table)

    @property
    def rmse_deg(self) -> float | None:
        """Root mean square error; None without a reference."""
        return _root_mean_square(self.errors_deg)


def _root_mean_square(values: FloatArray) -> float | None:
    return math.sqrt(float(np.mean(values**2))) if len(values) else None


@dataclass(frozen=True)
class Predictions(Answer):
    """The predictions of log files, and the faults of the files."""

    DOCUMENT = (
        "model output drives=predicted rows rows_estimated rmse_deg rows_quarantined suspicions"
    )

    model: str
    output: str
    predicted: tuple[PredictedDrive, ...]
    rows_quarantined: int
    suspicions: tuple[str, ...]
    alarm: str = ""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return sum(drive.rows for drive in self.predicted)

    @property
    def rows_estimated(self) -> int:
        """Number of rows with an estimate."""
        return sum(drive.rows_estimated for drive in self.predicted)

    @property
    def rmse_deg(self) -> float | None:
        """Root mean square error over all rows with a reference; None without one."""
        return _root_mean_square(np.concatenate([d.errors_deg for d in self.predicted]))

    def parts(self) -> Iterator[Part]:
        """Return the figures of each drive, and rows without an estimate."""
        yield TextTable(
            f"{self.model}: {pluralize(self.rows, 'row')} of "
            f"{pluralize(len(self.predicted), 'drive')}",
            "drive|rows|RMSE deg",
            self.predicted,
            "{drive_id}|{rows:,}|{rmse_deg:.4f}",
        )
        if missing := self.rows - self.rows_estimated:
            yield Remark(f"{pluralize(missing, 'row')} without an estimate: a signal is missing.")
        if self.rows_quarantined:
            yield Remark(f"{pluralize(self.rows_quarantined, 'row')} of the files unusable.")
        yield from (Remark(f"looks wrong: {text}") for text in self.suspicions)
        yield Remark(f"written to {self.output}")

    @property
    def problem(self) -> AlarmError | None:
        """The first alarm of a file."""
        return AlarmError(self.alarm) if self.alarm else None


def predict_logs(
    warehouse: Warehouse,
    version: ModelVersion,
    logs: Sequence[Path],
    mapping: Mapping,
    output: Path,
    *,
    replace: bool = False,
) -> Predictions:
    """Predict the side-slip angle of log files; write a table, and nothing to the data root.

    Raises `UsageError` for an unknown suffix or an existing output, `InputError` for a file, and
    `DataError` if the logs lack a signal of the model.
    """
    if output.suffix.lower() not in FORMATS:
        raise UsageError(f"{output}: choose a name in {', '.join(FORMATS)}.")
    if output.exists() and not replace:
        raise UsageError(f"{output} exists. Choose another name, or replace it: --replace")
    logs = list({log.resolve(): log for log in logs}.values())
    if output.resolve() in {
        file.resolve() for log in logs for file in getattr(log, "files", [log])
    }:
        raise UsageError(f"{output} is one of the logs. Choose another name.")
    predictor = Predictor.from_manifest(version.catalog.signals, version.manifest)
    missing = [name for name in predictor.plan.signals if name not in mapping.signal_names]
    if missing:
        raise DataError(
            f"{version.reference} needs {', '.join(missing)}, which the mapping {mapping.name} "
            "lacks. Map them, or publish a model without them: fleet-slip publish NAME --models "
            "LIST"
        )
    cars = calibrated_cars(warehouse) if predictor.plan.numbers else {}
    drives: dict[str, PredictedDrive] = {}
    rejected, suspicions, alarms = 0, list[str](), list[str]()
    for log in logs:
        try:
            predicted, faults, unusable = _predict_log(log, mapping, predictor, cars)
        except MissingColumnError as error:
            label = mapping.signal_catalog.label
            if label not in mapping.signals:
                raise
            signals = {name: c for name, c in mapping.signals.items() if name != label}
            unlabelled = mapping.model_copy(update={"signals": signals})
            predicted, faults, unusable = _predict_log(log, unlabelled, predictor, cars)
            suspicions.append(f"no reference: {error}")
        for drive in predicted:
            if drive.drive_id in drives:
                raise InputError(
                    f"{log}: the drive {drive.drive_id} is also in another log. Leave out one."
                )
            drives[drive.drive_id] = drive
        rejected += unusable
        suspicions += [f"{log}: {fault}" for fault in faults]
        alarms += [f"{log}: {fault}" for fault in faults if fault.does_harm]
    predictions = Predictions(
        version.reference,
        str(output),
        tuple(drives.values()),
        rejected,
        tuple(suspicions),
        next(iter(alarms), ""),
    )
    if not predictions.rows_estimated:
        raise DataError(
            f"no row of the logs has all of {', '.join(predictor.plan.signals)}, which "
            f"{version.reference} needs. Check them: fleet-slip ingest LOG --mapping "
            f"{mapping.name} --dry-run"
        )
    about = {"model": version.reference, "model_sha256": version.sha256, "mapping": mapping.name}
    content = _encode(output.suffix.lower(), [drive.table for drive in drives.values()], about)
    LocalFolder(output.parent).put(output.name, content)
    return predictions


def _predict_log(
    log: Path, mapping: Mapping, predictor: Predictor, cars: CarCounts
) -> tuple[list[PredictedDrive], tuple[Fault, ...], int]:
    """Predict the drives of a log; return them, the faults, and the number of unusable rows."""
    predicted = []
    with open_measured(log, mapping) as stream:
        for drive in stream.drives():
            rows = log_table([drive], mapping)
            label_rad, slow = label_of(mapping.signal_catalog, rows)
            drive_id, vehicle_id = (rows[name][0].as_py() for name in ("drive_id", "vehicle_id"))
            counts = counts_of(rows, predictor.plan, None, cars.get(vehicle_id))
            estimate = np.degrees(predictor(counts))
            reference = np.degrees(np.where(slow, np.nan, label_rad))
            columns = {
                "drive_id": pa.array([drive_id] * len(rows)).dictionary_encode(),
                "time_s": rows["tick"].to_numpy() / TICKS_PER_S,
                ESTIMATE: pa.array(estimate, from_pandas=True),
                REFERENCE: pa.array(reference, from_pandas=True),
            }
            estimated, errors = int(np.isfinite(estimate).sum()), estimate - reference
            errors = errors[np.isfinite(errors)]
            predicted.append(
                PredictedDrive(drive_id, vehicle_id, pa.table(columns), estimated, errors)
            )
        return predicted, stream.suspicions(), sum(stream.counts.quarantined.values())


def _encode(suffix: str, tables: Sequence[pa.Table], about: dict[str, str]) -> bytes:
    """Return the content of the output file."""
    if suffix == ".mf4":
        return _encode_mdf(tables, about)
    table = pa.concat_tables(tables).unify_dictionaries()
    stream = io.BytesIO()
    if suffix == ".csv":
        import polars as pl  # noqa: PLC0415 - slow to import

        pl.DataFrame(table).write_csv(stream)
    else:
        import pyarrow.parquet as pq  # noqa: PLC0415 - slow to import

        pq.write_table(table.replace_schema_metadata(about), stream)
    return stream.getvalue()


def _encode_mdf(tables: Sequence[pa.Table], about: dict[str, str]) -> bytes:
    """Return an MDF 4 file with a channel group for each drive, named after it."""
    with require_extra("logs", "an output in .mf4"):
        from asammdf import MDF  # noqa: PLC0415 - an extra
    stream = io.BytesIO()
    with MDF(version="4.10") as file:
        file.header.comment = "; ".join(f"{key}: {value}" for key, value in about.items())
        for table in tables:
            name, frame = table["drive_id"][0].as_py(), table.drop(["drive_id"]).to_pandas()
            frame = frame.set_index("time_s").rename_axis("time").dropna(axis=1, how="all")
            frame = frame.rename(columns=lambda column: column.removesuffix("_deg"))
            units = dict.fromkeys(frame.columns, "deg")
            file.append(frame, acq_name=name, comment=name, common_timebase=True, units=units)
        file.save(stream)
    return stream.getvalue()
