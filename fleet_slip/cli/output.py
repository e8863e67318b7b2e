"""What commands print: JSON for machines, tables for people, remarks on stderr."""

import json
import logging
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, is_dataclass
from decimal import Decimal
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from fleet_slip.errors import printable
from fleet_slip.runs.log import LOGGER

Json = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON on stdout.")]


def stdout() -> Console:
    """Return a console for results. Piped, it keeps to 200 columns and never wraps in mid-word."""
    return Console(width=None if sys.stdout.isatty() else 200, highlight=False, emoji=False)


def say(text: str, level: int = logging.INFO) -> None:
    """Print a remark on stderr, as it is; in JSON if the log is."""
    LOGGER.log(level, text)


def print_json(content: Any) -> None:
    """Print a JSON document; numbers that JSON does not know (NaN, infinity) become null.

    A dataclass is printed field by field, unless it has an `as_dict` that says otherwise. pydantic
    would write decimal numbers as texts, and every start would wait for it.
    """
    text = json.dumps(_for_json(content), indent=2, default=str, allow_nan=False)
    sys.stdout.write(text + "\n")


def _for_json(value: Any) -> Any:
    if hasattr(value, "as_dict"):
        value = value.as_dict()
    elif is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    match value:
        case dict():
            return {key: _for_json(item) for key, item in value.items()}
        case list() | tuple():
            return [_for_json(item) for item in value]
        case float() if not math.isfinite(value):
            return None
        case Decimal():
            return int(value) if value == value.to_integral_value() else float(value)
        case _:
            return value


def print_text(text: str) -> None:
    """Print a line for people on stdout, as it is."""
    print(text, flush=True)  # noqa: T201 - this is the one place that prints


def print_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1
) -> None:
    """Print a table; the first `left` columns are text, the others are numbers."""
    table = Table(box=None, pad_edge=False, header_style="bold", show_header=any(header))
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    if title:
        print_text(title)
    console = stdout()
    with console.capture() as captured:
        console.print(table)
    print_text("\n".join(line.rstrip() for line in captured.get().splitlines()))
