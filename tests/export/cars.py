"""Cars to run programs with."""

from collections.abc import Mapping
from dataclasses import dataclass

from fleet_slip.export.program import Program


@dataclass(frozen=True)
class Car:
    """Properties of a car: facts as in the metadata of a drive, numbers in counts."""

    facts: Mapping[str, object]
    numbers: Mapping[str, int]

    def fact_counts(self, program: Program) -> tuple[int | None, ...]:
        """Return the facts of a program as whole numbers; None: unknown."""
        return tuple(fact.count(self.facts.get(fact.name)) for fact in program.facts)

    def number_counts(self, program: Program) -> tuple[int | None, ...]:
        """Return the numbers of a program as counts; None: unknown."""
        return tuple(self.numbers.get(number.name) for number in program.numbers)
