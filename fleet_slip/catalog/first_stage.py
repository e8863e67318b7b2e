"""First-stage models: linear models whose estimate is an input of a second model (stacking).

The Gram rows of such a set have the name `SET_DIGEST`, with the first digits of the model's
checksum. To avoid leakage, each training drive uses the fit of the other folds.
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

DIGEST_DIGITS = 12
"""Hexadecimal digits of a checksum that name a model."""

MAX_SUM_BITS = 50
"""Bits of the largest sum of an estimate, so that twice the sum is exact in binary64."""

MIN_DIVISOR_BITS = 8
"""Bits of the smallest divisor: coefficients are multiples of 1/256 or finer."""


class FirstStageModel(Config):
    """A first-stage model, fitted to all drives and to all but each fold.

    Attributes
    ----------
    estimate
        Name of its estimate in `configs/features.toml`.
    fitted
        The fit to all drives.
    folds
        The fits without a fold, by the fold's name (`fold_of`).
    hashed
        Number of folds by the hash of the drive id; None if each drive is a fold.
    scale
        Physical value of one count of the estimate, in rad.
    models, models_sha256
        The model list that it was chosen from, and its checksum.
    feature_set
        Identity of the feature set of its Gram rows.
    cohort, drives
        Predicate and number of the training drives.
    drive_hashes
        The training drives, 16 digits each, sorted.
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
        """Checksum of the whole model."""
        return sha256_of(canonical_json(self.model_dump(mode="json")))

    @property
    def digest(self) -> str:
        """Name of the model: the first digits of its checksum."""
        return self.sha256[:DIGEST_DIGITS]

    def fold_of(self, drive_id: str) -> str | None:
        """Return the fold of a training drive; None for other drives."""
        fold = drive_id if self.hashed is None else str(hash_fold(drive_id, self.hashed) + 1)
        return fold if fold in self.folds else None

    def in_fold(self, fold: str | None) -> Combination:
        """Return the fit without a fold; the fit to all drives if there is no such fold."""
        fit = self.folds.get(fold, self.fitted) if fold is not None else self.fitted
        return fit.model_copy(update={"line": self.digest})


@dataclass
class EstimateSubstitution:
    """Replaces the estimate in definitions by the model's fit without a fold."""

    model: FirstStageModel
    fold: str | None
    _copies: dict[int, Made] = field(default_factory=dict)
    """By the identity of the original: columns that share a part share its copy."""

    def __call__(self, definition: Definition) -> Definition:
        """Return a definition with the fit in place of the estimate."""
        changes: dict[str, object] = {}
        if definition.gate:
            gate = definition.gate
            changes["gate"] = gate.model_copy(update={"by": self(gate.by)})
        if definition.made is not None:
            key = id(definition.made)
            if key not in self._copies:
                self._copies[key] = (
                    self.model.in_fold(self.fold)
                    if definition.of == self.model.estimate
                    else self._copy(definition.made)
                )
            changes["made"] = self._copies[key]
        return definition.model_copy(update=changes) if changes else definition

    def _copy(self, composite: Made) -> Made:
        if isinstance(composite, Product):
            return composite.model_copy(update={"of": tuple(map(self, composite.of))})
        if isinstance(composite, Combination):
            terms = tuple((factor, self(column)) for factor, column in composite.terms)
            return composite.model_copy(update={"terms": terms})
        equations = [
            equation.model_copy(
                update={
                    "y": self(equation.y),
                    "x": tuple(x if isinstance(x, int) else self(x) for x in equation.x),
                }
            )
            for equation in composite.equations
        ]
        return composite.model_copy(update={"equations": tuple(equations)})


def integer_combination(
    intercept: Fraction, coefficients: Sequence[Fraction], columns: Sequence[Definition]
) -> Combination:
    """Return a linear model of counts with integer coefficients over a power of two.

    The divisor is the largest for which the sum is exact in binary64. Raises `QuestionError` if
    that divisor is too small.
    """
    sizes = [limit_of(column.bits) + 1 for column in columns]
    largest = abs(intercept) + sum(abs(g) * n for g, n in zip(coefficients, sizes, strict=True))
    bits = MAX_SUM_BITS - max(0, math.ceil(largest)).bit_length()
    if bits < MIN_DIVISOR_BITS:
        raise QuestionError("its coefficients are so large that its estimate would not be exact.")
    scaled = [round(value * 2**bits) for value in (intercept, *coefficients)]
    terms = tuple((c, column) for c, column in zip(scaled[1:], columns, strict=True) if c)
    return Combination(intercept=scaled[0], terms=terms, divisor=2**bits)
