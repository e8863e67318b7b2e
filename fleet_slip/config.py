"""Reading and validation of TOML files."""

import os
import re
import stat
import tomllib
from collections.abc import Mapping
from decimal import Decimal
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
)
from pydantic_core import ErrorDetails

from fleet_slip.errors import ConfigError, FleetSlipError, StorageError


class Config(BaseModel):
    """Base of all config models: immutable, without undeclared keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


ConfigT = TypeVar("ConfigT", bound=Config)
ModelT = TypeVar("ModelT", bound=BaseModel)


_TRIED = re.compile(r"[\[(]|^constrained-|^([A-Z][a-z]+){2,}$|^(str|int|float|decimal|bool)$")
"""Matches the names of types that pydantic inserts between keys."""


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("has characters that cannot be printed")
    return text


def added(default: object, **bounds: Any) -> Any:
    """Return a field that dumps omit at its default, so that it does not change older digests."""
    return Field(default=default, exclude_if=lambda value: value == default, **bounds)


Name = Annotated[str, StringConstraints(min_length=1, max_length=200), AfterValidator(_printable)]
"""Name of a column, a car or a file."""

PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]

LONGEST_FILE_BYTES = 2**20
LARGEST_EXPONENT = 400
FAULTS_SHOWN = 10
LONGEST_FAULT = 300
"""Characters of one fault in a message, which may quote the input."""


def read_named_file(
    file: Traversable,
    most_bytes: int = LONGEST_FILE_BYTES,
    error: type[FleetSlipError] = ConfigError,
) -> bytes:
    """Return the content of a regular file. Raises `error`.

    Devices do not end and pipes may never begin. Messages quote no content: the path may be
    `/etc/shadow`.
    """
    try:
        if not isinstance(file, Path):  # within an archive
            return file.read_bytes()
        # Without this flag, opening a pipe waits for someone to write into it.
        descriptor = os.open(file, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as stream:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise error(f"{file}: not a regular file. Give the path of a file.")
            content = stream.read(most_bytes + 1)
    except FileNotFoundError:
        raise error(f"{file}: no such file.") from None
    except (OSError, ValueError) as fault:
        reason = getattr(fault, "strerror", None) or "no file can have this name"
        raise error(f"{file}: cannot be read: {reason}.") from None
    if len(content) > most_bytes:
        raise error(f"{file}: larger than {most_bytes:,} bytes. Is it the right file?")
    return content


def load_toml(file: Traversable) -> dict[str, Any]:
    """Parse a TOML file, decimal numbers as exact `Decimal`. Raises `ConfigError`."""
    content = read_named_file(file)
    try:
        return tomllib.loads(content.decode("utf-8"), parse_float=_parse_decimal)
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: not UTF-8 text, from byte {error.start:,} on.") from None
    except RecursionError:
        raise ConfigError(f"{file}: nested too deeply.") from None
    except (ValueError, ArithmeticError) as error:  # TOML, a date, or the size of a number
        raise ConfigError(f"{file}: not valid TOML: {error}") from None


def _parse_decimal(text: str) -> Decimal:
    number = Decimal(text)
    if abs(number.adjusted()) > LARGEST_EXPONENT:  # as an integer it would take all memory
        raise ValueError(f"{text[:40]}: the exponent is out of range")
    return number


def load_config(file: Traversable, model: type[ConfigT], context: object = None) -> ConfigT:
    """Parse and validate a TOML file. Raises `ConfigError` with file, key, reason of each fault.

    `context` is passed to the validators of the model.
    """
    try:
        return model.model_validate(load_toml(file), context=context)
    except ValidationError as error:
        raise ConfigError(f"{file}: {faults_of(error)}") from None


def parse_document(
    content: Mapping[str, Any], model: type[ModelT], name: str, kind: str, context: object = None
) -> ModelT:
    """Return a document with a valid checksum. Raises `StorageError`: another program wrote it.

    `context` is passed to the validators of the model.
    """
    try:
        return model.model_validate(content, context=context)
    except ValidationError as error:
        raise StorageError(
            f"{name}: this program does not understand {kind}: {faults_of(error)}. Update "
            "fleet-slip, or publish again."
        ) from None


def faults_of(error: ValidationError) -> str:
    """Return the first faults on one line: key and reason."""
    reasons: dict[str, dict[str, None]] = {}
    for fault in error.errors(include_input=False, include_url=False):
        reasons.setdefault(_key_of(fault), {})[_reason_text(fault)] = None
    faults = [f"{key and f'{key}: '}{', or '.join(texts)}" for key, texts in reasons.items()]
    more = f"; and {len(faults) - FAULTS_SHOWN:,} more" if len(faults) > FAULTS_SHOWN else ""
    return "; ".join(fault[:LONGEST_FAULT] for fault in faults[:FAULTS_SHOWN]) + more


def _key_of(fault: ErrorDetails) -> str:
    """Return the key at fault, without the types that pydantic tried."""
    place = fault["loc"]
    unknown = len(place) - 1 if fault["type"] == "extra_forbidden" else None
    keys = [
        part
        for number, part in enumerate(place)
        if number == unknown or isinstance(part, int) or not _TRIED.search(part)
    ]
    return ".".join(map(str, keys))


def _reason_text(fault: ErrorDetails) -> str:
    """Return the reason of a fault: the text of pydantic or of a validator."""
    texts = {"missing": "is missing", "extra_forbidden": "unknown key"}
    text = fault["msg"].replace("Value error, ", "").replace("Input should be", "must be")
    return texts.get(fault["type"], text)
