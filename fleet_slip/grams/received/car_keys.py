"""The list of keys that cars sign messages with.

It is a CSV file with a line a key; the last three may be empty, and `valid_until` is the last
day:

    vehicle_id,public_key,valid_from,valid_until,revoked_since
    VIN1,MCowBQYDK2VwAyEA...,2024-01-01,,2024-06-01

`public_key` is the middle line of the .pub file of `fleet-slip keygen`. A car has one key at a
time. So the day of a drive tells which key signed its message, and what a revoked key signed is
what the car sent of these days.
"""

import base64
import binascii
import csv
import io
import os
from datetime import date
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationError, model_validator

from fleet_slip.catalogue.sources import RECEIVED
from fleet_slip.config import Config, faults_of, read_named_file
from fleet_slip.errors import ConfigError

KEYS_VARIABLE = "FLEET_SLIP_CAR_KEYS"
"""Environment variable: path of the list of keys. If it is set, messages must be signed."""

MOST_BYTES = 2**28
"""Size of the largest list that is read: one of a million cars."""

_DER = bytes.fromhex("302a300506032b6570032100")
"""What stands before the 32 bytes of an Ed25519 public key (RFC 8410)."""


def _require_ed25519(text: str) -> str:
    try:
        content = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        content = b""
    if not content.startswith(_DER) or len(content) != len(_DER) + 32:
        raise ValueError("is not an Ed25519 public key: take the middle line of the .pub file")
    return text


class CarKey(Config):
    """The key of a car, from its first day to its last."""

    vehicle_id: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,16}$")]
    public_key: Annotated[str, AfterValidator(_require_ed25519)]
    valid_from: date = date.min
    valid_until: date = date.max
    revoked_since: date | None = None

    @cached_property
    def bytes(self) -> bytes:
        """The key."""
        return base64.b64decode(self.public_key)[len(_DER) :]

    @property
    def condition(self) -> str:
        """SQL condition of the received Gram rows that are not to count: of the days since then."""
        first = max(self.valid_from, self.revoked_since or date.max)
        return (
            f"(source = '{RECEIVED}' AND vehicle_id = '{self.vehicle_id}' "
            f"AND day BETWEEN DATE '{first}' AND DATE '{self.valid_until}')"
        )


class CarKeys(Config):
    """The keys of all cars."""

    keys: tuple[CarKey, ...]

    @model_validator(mode="after")
    def _one_at_a_time(self) -> "CarKeys":
        for before, after in pairwise(
            sorted(self.keys, key=lambda k: (k.vehicle_id, k.valid_from))
        ):
            if before.vehicle_id == after.vehicle_id and before.valid_until >= after.valid_from:
                raise ValueError(f"{before.vehicle_id} has two keys on {after.valid_from}")
        return self

    @cached_property
    def _by_car(self) -> dict[str, list[CarKey]]:
        found: dict[str, list[CarKey]] = {}
        for key in self.keys:
            found.setdefault(key.vehicle_id, []).append(key)
        return found

    def of(self, vehicle_id: str, day: date) -> CarKey | None:
        """Return the key of a car on a day."""
        some = self._by_car.get(vehicle_id, ())
        return next((key for key in some if key.valid_from <= day <= key.valid_until), None)

    @property
    def revoked(self) -> tuple[CarKey, ...]:
        """The keys that were revoked."""
        return tuple(key for key in self.keys if key.revoked_since)


def load_car_keys() -> CarKeys | None:
    """Return the list of keys that the environment names, if any. Raises `ConfigError`."""
    configured = os.environ.get(KEYS_VARIABLE)
    if configured is None:
        return None
    if not configured.strip():
        raise ConfigError(
            f"${KEYS_VARIABLE} is set and empty. Name the list of keys, or unset it: an empty name "
            "does not switch signatures off."
        )
    path = Path(configured)
    try:
        changed_ns = path.stat().st_mtime_ns
    except OSError as error:
        raise ConfigError(f"{configured}: the list of keys cannot be read: {error}.") from None
    return _load(path, changed_ns)


@lru_cache(4)
def _load(path: Path, _changed_ns: int) -> CarKeys:
    try:
        content = io.StringIO(read_named_file(path, MOST_BYTES).decode("utf-8"), newline="")
        lines = csv.DictReader(content, strict=True)
        rows, columns = list(lines), lines.fieldnames or ()
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: the list of keys cannot be read: {error}.") from None
    if absent := {"vehicle_id", "public_key"}.difference(columns):
        raise ConfigError(
            f"{path}: the list of keys has no column {max(absent)}. Its first line names the "
            "columns: vehicle_id,public_key,valid_from,valid_until,revoked_since"
        )
    told = [{name or "": value for name, value in row.items() if value} for row in rows]
    try:
        return CarKeys.model_validate({"keys": told})
    except ValidationError as error:
        raise ConfigError(f"{path}: {faults_of(error)}") from None
