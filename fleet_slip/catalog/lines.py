"""Lines that are fitted before the columns of a feature set can be: their estimate is one of these.

Where a set has an estimate, Gram rows are of the set with a line, `SET_DIGEST`, by the first digits
of the line's checksum. A drive that the line was fitted to has the estimate of a line that was
fitted without it: the other would flatter itself.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from functools import cached_property

from fleet_slip.base import canonical_json, hash_fold, sha256_of
from fleet_slip.catalog.definitions import (
    Combination,
    Definition,
    Made,
    Product,
    limit_of,
)
from fleet_slip.catalog.signals import Identifier
from fleet_slip.config import Config
from fleet_slip.errors import QuestionError

DIGITS = 12

MOST_BITS, LEAST_BITS = 50, 8
"""Of the largest sum of an estimate, so that twice it is exact in binary64; of its divisor."""


class FittedLine(Config):
    """A fitted line, and for each fold of drives the line of all others.

    Attributes:
        estimate: which estimate of `configs/features.toml` it is.
        fitted: to all drives.
        folds: by the name of the fold, see `fold_of`.
        hashed: the number of folds that drives are dealt into by the hash of their id; None where
            each drive is a fold.
        scale: what a count of the estimate is worth, in rad.
        models, cohort, drives: the model list that it was chosen from, and what it was fitted to.
        feature_set: the identity of the set whose Gram rows these were.
        drive_hashes: of these drives, 16 digits each, sorted.
    """

    estimate: Identifier
    fitted: Combination
    folds: dict[str, Combination]
    hashed: int | None = None
    scale: Decimal
    models: str
    feature_set: str
    models_sha256: str
    cohort: str
    drives: int
    drive_hashes: str

    @cached_property
    def sha256(self) -> str:
        """Checksum of all that it says."""
        return sha256_of(canonical_json(self.model_dump(mode="json")))

    @property
    def digest(self) -> str:
        """The first digits of the checksum: its name."""
        return self.sha256[:DIGITS]

    def fold_of(self, drive_id: str) -> str | None:
        """Return the fold of a drive; None of one that no line was fitted without."""
        fold = drive_id if self.hashed is None else str(hash_fold(drive_id, self.hashed) + 1)
        return fold if fold in self.folds else None

    def in_fold(self, fold: str | None) -> Combination:
        """Return the line that was fitted without a fold; that of all drives where it has none."""
        one = self.folds.get(fold, self.fitted) if fold is not None else self.fitted
        return one.model_copy(update={"line": self.digest})


@dataclass
class Fitting:
    """Puts a line in the place of its estimate: of a fold, that fitted without it."""

    line: FittedLine
    fold: str | None
    _made: dict[int, Made] = field(default_factory=dict)

    def __call__(self, one: Definition) -> Definition:
        """Return a column in which the line makes the estimate."""
        changed: dict[str, object] = {}
        if one.gate:
            changed["gate"] = one.gate.model_copy(update={"by": self(one.gate.by)})
        if one.made is not None:
            key = id(one.made)  # equal ones stay one, as many columns have the same
            if key not in self._made:
                fitted = one.of == self.line.estimate
                self._made[key] = self.line.in_fold(self.fold) if fitted else self._copy(one.made)
            changed["made"] = self._made[key]
        return one.model_copy(update=changed) if changed else one

    def _copy(self, made: Made) -> Made:
        if isinstance(made, Product):
            return made.model_copy(update={"of": tuple(map(self, made.of))})
        if isinstance(made, Combination):
            terms = tuple((times, self(of)) for times, of in made.terms)
            return made.model_copy(update={"terms": terms})
        equations = [
            equation.model_copy(
                update={
                    "y": self(equation.y),
                    "x": tuple(of if isinstance(of, int) else self(of) for of in equation.x),
                }
            )
            for equation in made.equations
        ]
        return made.model_copy(update={"equations": tuple(equations)})


def whole_line(
    intercept: Fraction, coefficients: Sequence[Fraction], columns: Sequence[Definition]
) -> Combination:
    """Return a line of counts in whole numbers, as fine as their sum is exact in binary64.

    Raises `QuestionError` for coefficients so large that the sum could not be.
    """
    sizes = [limit_of(column.bits) + 1 for column in columns]
    largest = abs(intercept) + sum(abs(g) * n for g, n in zip(coefficients, sizes, strict=True))
    bits = MOST_BITS - max(0, math.ceil(largest)).bit_length()
    if bits < LEAST_BITS:
        raise QuestionError("its coefficients are so large that its estimate would not be exact.")
    scaled = [round(one * 2**bits) for one in (intercept, *coefficients)]
    terms = tuple((c, column) for c, column in zip(scaled[1:], columns, strict=True) if c)
    return Combination(intercept=scaled[0], terms=terms, divisor=2**bits)
