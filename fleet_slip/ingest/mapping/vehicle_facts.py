"""What is known of each car, from a table beside the mapping."""

import csv
import io
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, ValidationError, ValidationInfo

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.config import Config, Name, PositiveFloat, added, faults_of, read_named_file
from fleet_slip.errors import ConfigError

Told = TypeVar("Told")


def require_drive_column(told: Told, info: ValidationInfo) -> Told:
    """Return what is told of a drive. Raises `ValueError` if the catalogue has no such column."""
    if info.field_name not in catalogue().drive:
        raise ValueError(
            "the catalogue has no such drive column. Copy it from the shipped one: "
            "configs/signals.toml"
        )
    return told


OptionalFact = Annotated[Annotated[Name, AfterValidator(require_drive_column)] | None, added(None)]


class VehicleFacts(Config):
    """One car: what its drives say unless the mapping's `[drive]` says it."""

    vehicle_id: Name
    vehicle_model: Name | None = None
    mass_kg: PositiveFloat | None = None
    tyres: OptionalFact = None
    receiver: OptionalFact = None


def read_vehicle_facts(file: Path) -> tuple[VehicleFacts, ...]:
    """Read a CSV file: vehicle_id, and any other facts. Raises `ConfigError`, with the line."""
    content = read_named_file(file)
    try:
        lines = csv.DictReader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        columns, rows = lines.fieldnames or (), list(lines)
    except (ValueError, csv.Error):
        columns, rows = (), []
    if "vehicle_id" not in columns:
        raise ConfigError(
            f"{file}: vehicle_id is missing. A table of cars is CSV in UTF-8, whose first line "
            f"names its columns: {', '.join(VehicleFacts.model_fields)}."
        )
    found = tuple(_facts(file, line, row) for line, row in enumerate(rows, 2))
    names = [facts.vehicle_id for facts in found]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ConfigError(f"{file}: the car {twice!r} stands in it twice.")
    if not found:
        raise ConfigError(f"{file}: it has no row. It needs a header and one row for each car.")
    return found


def _facts(file: Path, line: int, row: dict[str, str]) -> VehicleFacts:
    try:
        return VehicleFacts.model_validate({key: text or None for key, text in row.items()})
    except ValidationError as error:
        raise ConfigError(f"{file}: line {line}: {faults_of(error)}") from None
