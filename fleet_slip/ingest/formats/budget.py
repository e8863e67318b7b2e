"""What a measured file may become while it is decoded: so many bytes and rows, in so many seconds.

A small file can stand for anything: a thousand times its size in zeros, a billion equal rows, a
view without end. How much is allowed follows from the file's size alone, so that it is known before
anything is decoded, and is the same for every format. A log that was measured is far below: a row
of it takes several bytes however well it is packed, since sensors are noisy.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import polars as pl

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats.meter import Meter
from fleet_slip.words import shown

FREE_ROWS, ROWS_PER_BYTE = 10**6, 4
"""Rows that any file may have, and rows for each of its bytes if those are more."""
FREE_BYTES, BYTES_PER_BYTE = 2**30, 200
"""The same for the bytes that it unfolds to."""
FREE_MEMORY, MEMORY_PER_BYTE = 2**30, 8
"""Memory that any reader of other people's may take, and more for each byte of its file."""
FREE_S, BYTES_PER_S = 60.0, 10**5
"""Seconds in which any file must be decoded, and a speed that no format falls below."""

_WAY_OUT = "Is it damaged? If it was measured so, export it as CSV that is not compressed."


@dataclass(frozen=True)
class Budget:
    """What one file may become."""

    file: Path
    size: int
    """Bytes of the file."""
    meter: Meter = field(default_factory=Meter, compare=False)
    """Who is told how much of it was passed over."""

    @classmethod
    def of(cls, file: Path, meter: Meter | None = None) -> "Budget":
        """Return the budget of a file. Raises `OSError`."""
        return cls(file, file.stat().st_size, meter or Meter())

    @property
    def rows(self) -> int:
        """Rows that are decoded at most."""
        return max(FREE_ROWS, ROWS_PER_BYTE * self.size)

    @property
    def unfolded(self) -> int:
        """Bytes that it unfolds to at most."""
        return max(FREE_BYTES, BYTES_PER_BYTE * self.size)

    @property
    def memory(self) -> int:
        """Bytes of memory that its reader takes at most, where that is a process of its own."""
        return FREE_MEMORY + MEMORY_PER_BYTE * self.size

    @property
    def seconds(self) -> float:
        """How long decoding takes at most."""
        return max(FREE_S, self.size / BYTES_PER_S)

    def require_rows(self, rows: int) -> None:
        """Raise `InputError` for more rows than a file of its size can have."""
        if rows > self.rows:
            raise InputError(
                f"{shown(self.file)}: {rows:,} rows or more in {self.size:,} bytes; of a file of "
                f"this size at most {self.rows:,} are read. {_WAY_OUT}"
            )

    def require_unfolded(self, size: int) -> None:
        """Raise `InputError` for more bytes than a file of its size can unfold to."""
        if size > self.unfolded:
            raise InputError(
                f"{shown(self.file)}: its {self.size:,} bytes unfold to {size:,} or more; of a "
                f"file of this size at most {self.unfolded:,} are read. {_WAY_OUT}"
            )

    def over_memory(self) -> InputError:
        """Return what to say of a file whose reader asked for more memory, or longer files."""
        return InputError(
            f"{shown(self.file)}: its {self.size:,} bytes unfold to more than {self.memory:,} in "
            f"memory or {self.unfolded:,} in a temporary file. {_WAY_OUT}"
        )

    def crashed(self) -> InputError:
        """Return what to say of a file whose reader ended without a word, or talks nonsense."""
        return InputError(
            f"{shown(self.file)}: its reader crashed, or was ended because it took more than "
            f"{self.memory:,} bytes of memory. {_WAY_OUT}"
        )

    def over_time(self) -> InputError:
        """Return what to say of a file that took too long."""
        return InputError(
            f"{shown(self.file)}: {self.seconds:,.0f} s did not suffice to decode its "
            f"{self.size:,} bytes. {_WAY_OUT}"
        )

    def damaged(self, what: str) -> InputError:
        """Return what to say of a file with something that no recorder writes."""
        return InputError(
            f"{shown(self.file)}: {what}, which no trace has: it is damaged. Record or copy it "
            "again."
        )

    def metered(self, batches: Iterator[pl.DataFrame]) -> Iterator[pl.DataFrame]:
        """Yield batches while rows and seconds last; the caller's own time does not count."""
        rows, seconds = 0, 0.0
        while True:
            began = time.monotonic()
            batch = next(batches, None)
            seconds += time.monotonic() - began
            if seconds > self.seconds:
                raise self.over_time()
            if batch is None:
                return
            rows += batch.height
            self.require_rows(rows)
            yield batch
