"""Reads a TOML file into a pydantic model; says what is wrong with it by file, key and reason."""

import tomllib
from collections.abc import Mapping
from decimal import Decimal
from importlib.resources.abc import Traversable
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from fleet_slip.errors import ConfigError, StorageError


class Config(BaseModel):
    """Base of all config models: immutable, and no key that is not declared."""

    model_config = ConfigDict(frozen=True, extra="forbid")


ConfigT = TypeVar("ConfigT", bound=Config)
ModelT = TypeVar("ModelT", bound=BaseModel)


LONGEST_FILE_BYTES = 2**20
FAULTS_SHOWN = 10
LONGEST_FAULT = 300
"""Characters of one fault that are shown; what was given may stand in it."""


def load_toml(file: Traversable) -> dict[str, Any]:
    """Parse a TOML file, decimal numbers as exact `Decimal`. Raises `ConfigError`."""
    try:
        with file.open("rb") as stream:
            content = stream.read(LONGEST_FILE_BYTES + 1)
        if len(content) > LONGEST_FILE_BYTES:
            raise ConfigError(f"{file}: larger than {LONGEST_FILE_BYTES:,} bytes. Is it TOML?")
        return tomllib.loads(content.decode("utf-8"), parse_float=Decimal)
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from None
    except RecursionError:
        raise ConfigError(f"{file}: nested too deeply.") from None
    except (ValueError, ArithmeticError) as error:  # of TOML, of a date, of a number's size
        raise ConfigError(f"{file}: not valid TOML: {error}") from None


def load_config(file: Traversable, model: type[ConfigT]) -> ConfigT:
    """Parse and validate a TOML file. Raises `ConfigError` with file, key, reason of each fault."""
    try:
        return model.model_validate(load_toml(file))
    except ValidationError as error:
        raise ConfigError(f"{file}: {faults_of(error)}") from None


def parse_document(content: Mapping[str, Any], model: type[ModelT], name: str, kind: str) -> ModelT:
    """Return the content of a document whose checksum is right. Raises `StorageError` otherwise.

    Then another version of the program has written it.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise StorageError(
            f"{name}: this program does not understand {kind}: {faults_of(error)}. Update "
            "fleet-slip, or publish again."
        ) from None


def faults_of(error: ValidationError) -> str:
    """Return what is wrong, key by key, on one line; of many faults the first."""
    faults = [
        f"{'.'.join(map(str, fault['loc'])) or 'file'}: {fault['msg']}"
        for fault in error.errors(include_input=False, include_url=False)
    ]
    text = "; ".join(_shortened(fault) for fault in faults[:FAULTS_SHOWN])
    more = len(faults) - FAULTS_SHOWN
    return text + (f"; and {more:,} more" if more > 0 else "")


def _shortened(fault: str) -> str:
    text = fault.replace("Value error, ", "")
    text = text.replace("Extra inputs are not permitted", "unknown key")
    return text if len(text) <= LONGEST_FAULT else text[:LONGEST_FAULT] + "…"
