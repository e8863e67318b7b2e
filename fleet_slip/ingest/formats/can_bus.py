"""What a mapping says of a CAN trace: the database of its messages, and the bus."""

import hashlib
from pathlib import Path

from pydantic import Field

from fleet_slip.config import Config, Name, read_named_file
from fleet_slip.errors import ConfigError

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
