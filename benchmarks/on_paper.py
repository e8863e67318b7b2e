"""What a fleet of millions would take a day: rows, bytes, cores and money, from measured figures.

    python -m benchmarks.on_paper [--figures FILE] [--cars 1e7] [--hours 1] ...

Takes bytes and processor seconds a row from the largest size in the figures of
`benchmarks.billion`. Every price is a parameter; the defaults are list prices of the large clouds,
rounded, and are assumptions, not measurements. Prints a Markdown table.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.documents import insert
from fleet_slip.catalogue.signals import SAMPLE_TIME_S, catalogue
from fleet_slip.regression.exact.gram import packed_size

FIGURES = Path(__file__).parent / "figures" / "billion.json"
INTEGERS = packed_size(len(catalogue().gram_signals) + 1)
"""Of a Gram row: the products of its counts and a constant 1; so n and the sums are among them."""
BYTES_PER_INTEGER = 8
GB = 1e9


@dataclass(frozen=True)
class Fleet:
    """A fleet, what was measured, and what things are taken to cost."""

    cars: float
    hours: float
    drives: float
    days_kept: float
    gram_row_bytes: float
    bytes_per_row: float
    cpu_s_per_row: float
    storage_price: float
    core_price: float
    upload_price: float

    @property
    def rows(self) -> float:
        """Rows a day."""
        return self.cars * self.hours * 3600 / SAMPLE_TIME_S

    @property
    def log_bytes(self) -> float:
        """Bytes of logs a day."""
        return self.rows * self.bytes_per_row

    @property
    def gram_rows(self) -> float:
        """Gram rows a day."""
        return self.cars * self.drives

    @property
    def core_hours(self) -> float:
        """Core hours a day that the Gram job takes."""
        return self.rows * self.cpu_s_per_row / 3600

    def table(self) -> str:
        """Return the table."""
        sent = self.gram_rows * INTEGERS * BYTES_PER_INTEGER
        stored = self.gram_rows * self.gram_row_bytes
        month = 30.4
        rows = [
            ("rows a day", f"{self.rows:.3g}", ""),
            (
                "logs a day, sent",
                _size(self.log_bytes),
                _money(self.log_bytes / GB * self.upload_price),
            ),
            (
                f"logs stored, those of {self.days_kept:g} days",
                _size(self.log_bytes * self.days_kept),
                _money(self.log_bytes * self.days_kept / GB * self.storage_price / month),
            ),
            (
                "the Gram job, core hours a day",
                f"{self.core_hours:,.0f} ({self.core_hours / 24:,.1f} cores all day)",
                _money(self.core_hours * self.core_price),
            ),
            ("Gram rows a day", f"{self.gram_rows:.3g}", ""),
            (
                "Gram rows stored, those of a day",
                _size(stored),
                _money(stored / GB * self.storage_price),
            ),
            (
                f"instead of logs: {INTEGERS} integers a drive, sent",
                _size(sent),
                _money(sent / GB * self.upload_price),
            ),
        ]
        lines = ["| what | how much | US$ a day |", "| --- | ---: | ---: |"]
        return "\n".join([*lines, *(f"| {a} | {b} | {c} |" for a, b, c in rows)])


def _size(count: float) -> str:
    for unit, size in (("PB", 1e15), ("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= size:
            return f"{count / size:,.1f} {unit}"
    return f"{count:,.0f} B"


def _money(dollars: float) -> str:
    return f"{dollars:,.0f}" if dollars >= 10 else f"{dollars:.2f}"


def measured_figures(file: Path) -> tuple[float, float]:
    """Return bytes a row, and processor seconds of the Gram job a row, of the largest size."""
    figures: dict[str, Any] = json.loads(file.read_text("utf-8"))
    largest = figures[max(figures, key=int)]
    return (
        largest["size_bytes"] / largest["rows"],
        largest["steps"]["gram"]["cpu_s"] / largest["rows"],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--figures", type=Path, default=FIGURES)
    parser.add_argument("--cars", type=float, default=1e7)
    parser.add_argument("--hours", type=float, default=1, help="driven a day")
    parser.add_argument("--drives", type=float, default=1, help="of a car a day")
    parser.add_argument("--days-kept", type=float, default=30, help="days that logs are kept")
    parser.add_argument("--gram-row-bytes", type=float, default=460, help="as stored")
    parser.add_argument("--storage-price", type=float, default=0.023, help="US$ a GB and month")
    parser.add_argument("--core-price", type=float, default=0.045, help="US$ a core hour")
    parser.add_argument("--upload-price", type=float, default=0.5, help="US$ a GB from a car")
    parser.add_argument("--document", type=Path, help="a page to put the table into")
    options = vars(parser.parse_args())
    document = options.pop("document")
    bytes_per_row, cpu_s_per_row = measured_figures(options.pop("figures"))
    fleet = Fleet(**options, bytes_per_row=bytes_per_row, cpu_s_per_row=cpu_s_per_row)
    print(fleet.table())
    if document:
        insert(document, "on paper", fleet.table())


if __name__ == "__main__":
    main()
