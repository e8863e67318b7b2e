"""The checks for faulty sensors and labels, of `checks.toml`, and the faults that they report.

`ingest` checks a log and the rows of its drives. `quality`, `publish` and `nightly` check the rows
of some drives, and the Gram rows of all drives. Only `checks.toml` contains thresholds; messages
show them, and docs/quality.md lists them.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from math import inf
from pathlib import Path
from typing import Any, Literal

KINDS = {
    "absent": "no sign in",
    "cars": "several cars in",
    "no slip": "no slip in",
    "place": "misplaced",
    "time": "unknown",
    "values": "wrong values of",
}
"""Words before the signals of a fault, where these are not its kind."""


@dataclass(frozen=True)
class Fault:
    """A relation that a drive or a log contradicts.

    Attributes
    ----------
    kind
        Kind of the fault, such as stuck, reversed, swapped, scaled, biased or late; see `CHECKS`.
    signals
        The signals in doubt.
    figure
        The evidence, as a phrase.
    remedy
        The change in the mapping, or another remedy, as a sentence.
    """

    kind: str
    signals: tuple[str, ...]
    figure: str
    remedy: str = ""

    def __str__(self) -> str:
        """Return one line."""
        kind = KINDS.get(self.kind, self.kind)
        return f"{kind} {', '.join(self.signals)}? {self.figure}. {self.remedy}"

    @property
    def does_harm(self) -> bool:
        """Return False for a fault that learning corrects."""
        return self.kind != "scale"


@dataclass(frozen=True)
class Check:
    """A relation that sound data satisfy.

    Attributes
    ----------
    kind
        Kind of the faults that it reports.
    scope
        Compared data: rows of a log, signals of a drive, a drive with its peers, or the label.
    reads
        Input: a log during ingest, rows of a drive, or Gram rows of all drives.
    message
        Evidence of a fault, with fields for figures; {low} and {high} are the threshold.
    low, high
        Lowest and highest value of sound data.
    unit
        Unit of the threshold.
    remedy
        The change that corrects the fault.
    source
        Source of the threshold, if it is not this table.
    remedy_of_velocities
        The remedy if the label is computed from velocities; empty: the same.
    """

    kind: str
    scope: Literal["row", "drive", "peers", "label"]
    reads: Sequence[Literal["log", "rows", "Gram rows"]]
    message: str
    remedy: str
    low: float = -inf
    high: float = inf
    unit: str = ""
    source: str = ""
    remedy_of_velocities: str = ""

    def passes(self, value: float) -> bool:
        """Return True for a value of sound data."""
        return self.low <= value <= self.high

    def test(self, value: float, *signals: str, **figures: Any) -> "list[Fault]":
        """Return the fault of signals in a list; empty for a value of sound data."""
        return [] if self.passes(value) else [self.fault(*signals, **figures)]

    def fault(self, *signals: str, **figures: Any) -> Fault:
        """Return a fault of signals; `low` and `high` among the figures narrow the threshold."""
        values = {"low": self.low, "high": self.high, **figures}
        return Fault(
            self.kind, signals, self.message.format(**values), self.remedy.format(**values)
        )


CHECKS: Mapping[str, Check] = {
    name: Check(**content)
    for name, content in tomllib.loads(
        Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    ).items()
}
"""All checks by name, in the order in which they run."""


FIRST_DAY = date(2000, 1, 1)
ROLLOVER = timedelta(weeks=1024)
"""Period after which the week number of GPS restarts: a receiver may be that early."""
MAX_BACKLOG = timedelta(weeks=4)
"""Time between a drive and the file that contains it, by which a rollover is recognized."""


def implausible_day(day: date, written: date) -> str:
    """Return the reason why a day is implausible for a drive, empty for plausible days.

    `written` is the day on which its file was written.
    """
    if day < FIRST_DAY:
        return f", before {FIRST_DAY}"
    if day > max(written, date.today()) + timedelta(days=1):
        return ", in the future"
    if abs(written - day - ROLLOVER) <= MAX_BACKLOG:
        return ", 1024 weeks before the file was written: the week number of GPS has rolled over"
    return ""
