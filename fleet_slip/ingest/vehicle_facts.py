"""What is known of each car, from a table beside the mapping."""

import csv
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, Field, ValidationError

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.config import LONGEST_FILE_BYTES, Config, faults_of
from fleet_slip.errors import ConfigError
from fleet_slip.ingest.names import Name, PositiveFloat

Told = TypeVar("Told")


def require_tyres_column(told: Told) -> Told:
    """Return what is told of tyres. Raises `ValueError` if no column of the catalogue takes it."""
    if "tyres" not in catalogue().drive:
        raise ValueError(
            "the catalogue has no such drive column. Copy it from the shipped one: "
            "configs/signals.toml"
        )
    return told


class VehicleFacts(Config):
    """One car: what its drives say unless the mapping's `[drive]` says it."""

    vehicle_id: Name
    vehicle_model: Name | None = None
    mass_kg: PositiveFloat | None = None
    tyres: Annotated[Name, AfterValidator(require_tyres_column)] | None = Field(
        default=None, exclude_if=lambda value: value is None
    )


def read_vehicle_facts(file: Path) -> tuple[VehicleFacts, ...]:
    """Read a CSV file with a header: vehicle_id, and any of the other facts.

    Raises `ConfigError` with line and column of what is wrong.
    """
    try:
        if file.stat().st_size > LONGEST_FILE_BYTES:
            raise ConfigError(f"{file}: larger than {LONGEST_FILE_BYTES:,} bytes.")
        with file.open(encoding="utf-8-sig", newline="") as stream:
            rows = list(csv.DictReader(stream, strict=True))
    except (OSError, ValueError, csv.Error) as error:
        raise ConfigError(f"{file}: cannot be read as a CSV file: {error}") from None
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
