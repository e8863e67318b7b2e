"""Reads a TOML file into a pydantic model; says what is wrong with it by file, key and reason."""

import tomllib
from decimal import Decimal
from importlib.resources.abc import Traversable
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from fleet_slip.errors import ConfigError


class Config(BaseModel):
    """Base of all config models: immutable, and no key that is not declared."""

    model_config = ConfigDict(frozen=True, extra="forbid")


ConfigT = TypeVar("ConfigT", bound=Config)


def load_toml(file: Traversable) -> dict[str, Any]:
    """Parse a TOML file, decimal numbers as exact `Decimal`. Raises `ConfigError`."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"), parse_float=Decimal)
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{file}: not valid TOML: {error}") from None


def load_config(file: Traversable, model: type[ConfigT]) -> ConfigT:
    """Parse and validate a TOML file. Raises `ConfigError` with file, key, reason of each fault."""
    try:
        return model.model_validate(load_toml(file))
    except ValidationError as error:
        raise ConfigError(f"{file}: {faults_of(error)}") from None


def faults_of(error: ValidationError) -> str:
    """Return what is wrong, key by key, on one line."""
    faults = (
        f"{'.'.join(map(str, fault['loc'])) or 'file'}: {fault['msg']}" for fault in error.errors()
    )
    text = "; ".join(faults).replace("Value error, ", "")
    text = text.replace("Extra inputs are not permitted", "unknown key")
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
