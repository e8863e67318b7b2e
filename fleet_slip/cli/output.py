"""What commands print: JSON for machines, tables for people, remarks on stderr."""

import json
import logging
import string
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet_slip.base import document_of
from fleet_slip.cli.streams import wrapped
from fleet_slip.errors import printable
from fleet_slip.storage.runs import LOGGER

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from fleet_slip.regression.figures import Figures

Json = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON on stdout.")]


def stdout() -> "Console":
    """Return a console for results. Piped, it keeps to 200 columns and never wraps in mid-word."""
    from rich.console import Console  # noqa: PLC0415 - JSON waits for none

    return Console(width=None if sys.stdout.isatty() else 200, highlight=False, emoji=False)


def say(text: str, level: int = logging.INFO) -> None:
    """Print a remark on stderr, as it is; in JSON if the log is."""
    LOGGER.log(level, text)


def print_json(content: Any) -> None:
    """Print results as a JSON document; see `document_of`."""
    sys.stdout.write(json_text(content))


def json_text(content: Any) -> str:
    """Return a JSON document as `print_json` prints it."""
    return json.dumps(document_of(content), indent=2, default=str, allow_nan=False) + "\n"


def print_text(text: str) -> None:
    """Print text for people on stdout; a terminal is shown lines that break between words."""
    _print_lines(wrapped(text, stdout().width) if sys.stdout.isatty() else text)


def print_line(text: str) -> None:
    """Print a line on stdout, as wide as the console is, without markup."""
    stdout().print(text, markup=False)


def _print_lines(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - this is the one place that prints


def print_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1
) -> None:
    """Print a table; the first `left` columns are text, the others are numbers.

    Words and numbers are never broken. Where a terminal is too narrow for that, columns move
    closer; where that is not enough, every row becomes a paragraph with a line for each column.
    """
    from rich.table import Table  # noqa: PLC0415 - JSON waits for none
    from rich.text import Text  # noqa: PLC0415

    shown = [[printable(cell) for cell in row] for row in rows]
    console = stdout()
    fitting = ((gap, _fit_columns(header, shown, console.width, gap)) for gap in GAPS)
    gap, widths = next((found for found in fitting if found[1]), (0, None))
    if widths is None:
        table = _paragraphs(header, shown)
    else:
        table = Table(
            box=None,
            pad_edge=False,
            padding=(0, gap, 0, 0),
            header_style="bold",
            show_header=any(header),
        )
        for i, (name, width) in enumerate(zip(header, widths, strict=True)):
            table.add_column(name, justify="left" if i < left else "right", width=width)
        for row in shown:
            table.add_row(*map(Text, row))
    if title:
        print_text(title)
    with console.capture() as captured:
        console.print(table)
    _print_lines("\n".join(line.rstrip() for line in captured.get().splitlines()))


class _Cells(string.Formatter):
    """Formats by the fields of a record or a mapping; None is nothing, and texts stand in a row."""

    def __init__(self, row: Any) -> None:
        self.row = row

    def get_value(self, key: int | str, args: Any, kwargs: Any) -> Any:  # noqa: ARG002 - of the base
        """Return a field."""
        return self.row[key] if isinstance(self.row, Mapping) else getattr(self.row, str(key))

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a value as a table shows it."""
        if isinstance(value, tuple | list):
            return " ".join(map(str, value))
        return cell(value, format_spec)


def print_records(title: str, header: str, row: str, records: Iterable[Any], left: int = 1) -> None:
    """Print records or mappings; `row` has formats of their fields, such as `{name}|{rmse:.4f}`."""
    cells = ([_Cells(one).format(form) for form in row.split("|")] for one in records)
    print_table(title, header.split("|"), cells, left)


All = Annotated[bool, typer.Option("--all", help="Print all of it, not a screen alone.")]


def cell(value: Any, form: str = "") -> str:
    """Return a value as a table shows it; nothing for None."""
    return "" if value is None else format(value, form)


def figures_cells(figures: "Figures") -> list[str]:
    """Return correlation, RMSE, mean and standard deviation of an error as a table shows them."""
    row = "{correlation:.4f}|{rmse_deg:.4f}|{error_mean_deg:+.4f}|{error_std_deg:.4f}"
    return _Cells(figures).format(row).split("|")


GAPS = (2, 1)
"""Spaces between two columns: usually, and where a terminal is narrow."""


def _fit_columns(
    header: Sequence[str], rows: Sequence[Sequence[str]], width: int, gap: int
) -> list[int] | None:
    """Return how wide each column is, none less than its longest word; None if they do not fit."""
    from rich.cells import cell_len  # noqa: PLC0415

    columns = [[name, *(row[i] for row in rows)] for i, name in enumerate(header)]
    wished = [max(map(cell_len, cells)) for cells in columns]
    widths = [max((cell_len(w) for c in cells for w in c.split()), default=0) for cells in columns]
    left = width - sum(widths) - gap * (len(widths) - 1)
    if left < 0:
        return None
    while left and widths != wished:
        wanting = [i for i in range(len(widths)) if widths[i] < wished[i]]
        widths[min(wanting, key=widths.__getitem__)] += 1  # many narrow columns before a wide one
        left -= 1
    return widths


def _paragraphs(header: Sequence[str], rows: Sequence[Sequence[str]]) -> "Table":
    """Return a table of two columns: what a figure is called, and the figure."""
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(justify="left", no_wrap=True)
    table.add_column(justify="left", overflow="fold")
    for row in rows:
        for name, cell in zip(header, row, strict=True):
            table.add_row(Text(name, style="bold"), Text(cell))
        table.add_row("", "")
    return table
