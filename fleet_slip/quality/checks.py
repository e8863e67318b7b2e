"""Checks and the faults that they report."""

from dataclasses import dataclass

KINDS = {
    "absent": "no sign in",
    "cars": "several cars in",
    "no slip": "no slip in",
    "place": "misplaced",
    "time": "unknown",
    "values": "wrong values of",
}
"""Kinds of faults that are said in other words before the signals."""


@dataclass(frozen=True)
class Fault:
    """What looks wrong.

    Attributes:
        kind: stuck, magnitude, reversed, swapped, saturated, scaled, biased, noisy, unexplained, no
            slip (a course that is a heading), place, repeated (rows count twice); of a log also
            absent, values, texts, time, cars, or scale, which does no harm.
        signals: those concerned; of an unexplained fault, the one that is furthest off.
        figure: what shows it.
        remedy: what to try in the mapping, where something can be tried there.
    """

    kind: str
    signals: tuple[str, ...]
    figure: str
    remedy: str = ""

    def __str__(self) -> str:
        """Return it as one line."""
        kind = KINDS.get(self.kind, self.kind)
        return f"{kind} {', '.join(self.signals)}? {self.figure}. {self.remedy}"

    @property
    def does_harm(self) -> bool:
        """Whether it calls for attention, in an ingest as in a night."""
        return self.kind != "scale"
