"""What can be wrong with signals of a drive, whoever finds it: ingest, quality, publish, nights."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """What looks wrong.

    Attributes:
        kind: stuck, magnitude, reversed, swapped, saturated, scaled, biased, noisy, unexplained, no
            slip (a course that is a heading), place, repeated (rows count twice); of a log also
            late, absent, values, texts, time, cars, or scale, which does no harm.
        signals: those concerned; of an unexplained fault, the one that is furthest off.
        figure: what shows it.
        remedy: what to try in the mapping, where something can be tried there.
        value: how late, in seconds.
    """

    kind: str
    signals: tuple[str, ...]
    figure: str
    remedy: str = ""
    value: float | None = None

    def __str__(self) -> str:
        """Return it as one line."""
        return f"{self.kind} {', '.join(self.signals)}? {self.figure}. {self.remedy}"
