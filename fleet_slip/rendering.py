"""Display of results: texts, tables and remarks."""

import string
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from typing import Any

from fleet_slip.base import Record
from fleet_slip.errors import FleetSlipError, printable

GAP = 2
"""Spaces between two columns."""
FILE_WIDTH = 200
"""Line width in characters for files and pipes."""


class Remark(str):
    """A remark beside a result, which commands print on stderr."""

    __slots__ = ()


@dataclass(frozen=True)
class TextTable:
    """A table of records, mappings or tuples; `row` formats a record: `{name}|{rmse_deg:.4f}`.

    Without `row`, records are sequences of cells. The first `text_columns` columns are text, the
    others numbers. None is an empty cell; a list is joined.
    """

    title: str
    header: str
    records: Iterable[Any]
    row: str = ""
    text_columns: int = 1

    def text(self, width: int = FILE_WIDTH, *, bold: bool = False) -> str:
        """Return the table within `width`; words and numbers are not broken.

        If it does not fit, each row becomes a paragraph with a line per column.
        """
        header = self.header.split("|")
        rows = [[printable(text) for text in self._cells(record)] for record in self.records]
        widths = _fit_columns(header, rows, width)
        if widths is None:
            return _paragraphs(header, rows, width)
        sides = [str.ljust if i < self.text_columns else str.rjust for i in range(len(header))]

        def lines(cells: Sequence[str], *, below: bool = False) -> Iterator[str]:
            wrapped = [_wrap(text, wide) for text, wide in zip(cells, widths, strict=True)]
            high = max(map(len, wrapped))
            if below:
                wrapped = [[""] * (high - len(record)) + record for record in wrapped]
            for texts in zip_longest(*wrapped, fillvalue=""):
                padded = (
                    side(text, wide - _cells_of(text) + len(text))
                    for side, text, wide in zip(sides, texts, widths, strict=True)
                )
                yield (" " * GAP).join(padded).rstrip()

        head = [*lines(header, below=True)] if any(header) else []
        if bold:
            head = [f"\x1b[1m{line}\x1b[0m" for line in head]
        return "\n".join([*head, *(line for record in rows for line in lines(record))])

    def _cells(self, record: Any) -> list[str]:
        if not self.row:
            return [*map(_FORMATTER.text, record)]
        return [_FORMATTER.vformat(form, (record,), {}) for form in self.row.split("|")]


class _Formatter(string.Formatter):
    """Formats the fields of one record."""

    def get_value(self, key: int | str, args: Sequence[Any], kwargs: Any) -> Any:  # noqa: ARG002
        """Return a field of the record."""
        (record,) = args
        if isinstance(key, int) or isinstance(record, Mapping):
            return record[key]
        return getattr(record, key)

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return the text of a field."""
        return self.text(value, format_spec)

    @staticmethod
    def text(value: Any, form: str = "") -> str:
        """Return the text of a value."""
        if isinstance(value, tuple | list):
            return " ".join(map(str, value))
        return "" if value is None else format(value, form)


_FORMATTER = _Formatter()

Part = str | TextTable
"""A text, a `Remark` or a table."""


class Answer(Record):
    """A result that commands, `str` and notebooks display."""

    def parts(self) -> Iterable[Part]:
        """Return the displayed parts; some classes accept `everything` for a full display."""
        raise NotImplementedError

    @property
    def problem(self) -> FleetSlipError | None:
        """The error with which a command fails after displaying the result."""
        return None

    def __str__(self) -> str:
        texts = (
            [part.title, part.text()] if isinstance(part, TextTable) else [part]
            for part in self.parts()
        )
        return "\n".join(text for block in texts for text in block if text)

    def _repr_html_(self) -> str:
        """Return the display of a notebook."""
        return f"<pre>{escape(str(self))}</pre>"


def wrap_lines(text: str, width: int) -> str:
    """Wrap lines between words, except indented ones, which users copy."""
    return "\n".join(
        line if len(line) <= width or line.startswith("  ") else "\n".join(_wrap(line, width))
        for line in text.split("\n")
    )


def _wrap(text: str, width: int) -> list[str]:
    if len(text) <= width:
        return [text]
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def _cells_of(text: str) -> int:
    """Return the number of terminal cells of a text: East Asian letters take two."""
    if text.isascii():
        return len(text)
    from rich.cells import cell_len  # noqa: PLC0415 - names of most fleets need none

    return cell_len(text)


def _fit_columns(
    header: Sequence[str], rows: Sequence[Sequence[str]], width: int
) -> list[int] | None:
    """Return the column widths, at least the longest word each; None if they do not fit."""
    columns = [[name, *(row[i] for row in rows)] for i, name in enumerate(header)]
    wished = [max(map(_cells_of, cells)) for cells in columns]
    widths = [max((_cells_of(w) for c in cells for w in c.split()), default=0) for cells in columns]
    free = width - sum(widths) - GAP * (len(widths) - 1)
    if free < 0:
        return None
    while free and widths != wished:
        wanting = [i for i in range(len(widths)) if widths[i] < wished[i]]
        widths[min(wanting, key=widths.__getitem__)] += 1  # many narrow columns before a wide one
        free -= 1
    return widths


def _paragraphs(header: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> str:
    """Return rows as paragraphs: one line per column, with its name and value."""
    wide = max(map(len, header))
    lines = []
    for row in rows:
        for name, text in zip(header, row, strict=True):
            first, *more = _wrap(text, max(width - wide - 2, 1)) or [""]
            lines += [f"{name:<{wide}}  {first}", *(" " * (wide + 2) + text for text in more)]
        lines.append("")
    return "\n".join(line.rstrip() for line in lines)
