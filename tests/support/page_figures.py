"""Figures in pages that `make bench` measures again, each before a mark that readers do not see.

    | the query in use | 0.26 <!-- bench pipeline: number 2 after "query in use" --> |

The mark says where the benchmark prints the figure: which number behind a label. Ratios are
compared as they are. The mark of a processor time ends with `, yardstick 1.9 s`, what the yardstick
took when the figure was written: it is compared in yardsticks, since machines differ.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

ALLOWED = 0.2
_USAGE = '<!-- bench NAME: number N after "LABEL"[, yardstick S s] -->'
_MARK = re.compile(r'(\w+): number ([1-9]\d*) after "([^"]+)"(?:, yardstick ([\d.]+) s)?')
_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?")


@dataclass(frozen=True)
class PageFigure:
    """A figure as a page has it, and where a benchmark prints it; a ratio has no yardstick."""

    place: str
    written: float
    benchmark: str
    number: int
    label: str
    yardstick_s: float | None

    def departure(self, output: str, yardstick_s: float) -> str | None:
        """Return what to say if the output has a figure that is more than a fifth another."""
        rests = [line.partition(self.label)[2] for line in output.splitlines()]
        printed = next((found for found in map(_NUMBER.findall, rests) if found), [])
        told = f"{self.place}: {self.written:g} is written, but {self.benchmark}"
        if len(printed) < self.number:
            return f"{told} prints no number {self.number} after {self.label!r}"
        measured = (
            _value(printed[self.number - 1]) * (self.yardstick_s or yardstick_s) / yardstick_s
        )
        if abs(measured - self.written) <= ALLOWED * self.written:
            return None
        return f"{told} gives {measured:.4g} ({self.label!r}, as the yardstick measures)"


def page_figures(pages: Iterable[Path]) -> Iterator[PageFigure]:
    """Yield the figures that are marked in pages.

    Raises `ValueError` where a mark is wrong, or no figure stands before it.
    """
    for page in pages:
        for line, text in enumerate(page.read_text("utf-8").splitlines(), 1):
            for mark in re.finditer(r"<!-- bench .*?-->", text):
                place = f"{page.name}:{line}"
                told = _MARK.fullmatch(mark[0].removeprefix("<!-- bench ").removesuffix(" -->"))
                before = _NUMBER.findall(text[: mark.start()].rpartition("-->")[2])
                if not told or not before:
                    raise ValueError(f"{place}: write a figure and {_USAGE}, not {mark[0]}")
                benchmark, number, label, took_s = told.groups()
                written_s = float(took_s) if took_s else None
                yield PageFigure(
                    place, _value(before[-1]), benchmark, int(number), label, written_s
                )


def _value(number: str) -> float:
    return float(number.replace(",", ""))
