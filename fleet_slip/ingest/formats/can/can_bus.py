"""What a mapping says of a CAN trace: the database of its messages, and the bus."""

import hashlib
import re
from pathlib import Path
from typing import Any

from pydantic import Field

from fleet_slip.config import Config, Name, read_named_file
from fleet_slip.errors import ConfigError, InputError
from fleet_slip.ingest.formats.log_source import reading_with
from fleet_slip.words import shown

FORMATS = {".dbc": "dbc", ".arxml": "arxml", ".kcd": "kcd", ".sym": "sym"}
MAX_DATABASE_BYTES = 2**28


class CanBus(Config):
    """The database of a CAN trace. Its content, not its path, is part of a mapping's identity."""

    database: Name = Field(exclude=True)
    """Path of a DBC, ARXML, KCD or SYM file, seen from the mapping's own."""
    channel: Name | None = None
    """The bus, as the trace calls it; needed where a message occurs on several."""
    text: str = Field(default="", exclude=True, repr=False)
    """What is in the database, once the mapping was loaded."""
    digest: str = ""
    """SHA-256 of it."""

    @property
    def format(self) -> str:
        """What the database is written in."""
        return FORMATS[Path(self.database).suffix.lower()]


def read_can_database(bus: CanBus, folder: Path) -> CanBus:
    """Return the bus with the content of its database. Raises `ConfigError`."""
    file = folder / bus.database
    if file.suffix.lower() not in FORMATS:
        raise ConfigError(f"{file}: a CAN database is a file {', '.join(FORMATS)}.")
    content = read_named_file(file, MAX_DATABASE_BYTES)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("cp1252", "replace")  # what most tools on Windows write
    digest = hashlib.sha256(content).hexdigest()
    return bus.model_copy(update={"text": text, "digest": digest})


def parse_database(bus: CanBus) -> Any:
    """Return the messages of a database. Raises `InputError`, which quotes no line of it."""
    database = Path(bus.database)
    with reading_with(database, "cantools") as cantools:
        try:
            return cantools.database.load_string(bus.text, bus.format, strict=False)
        except Exception as error:
            place = re.search(r"line \d+", str(error))
            raise InputError(
                f"{shown(database)}: cantools cannot read it as {bus.format.upper()}"
                f"{f', from {place[0]} on' if place else ''}. Is it the right file, and complete?"
            ) from None
