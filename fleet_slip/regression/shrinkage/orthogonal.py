"""The orthogonal basis of a nested order, in which shrinkage acts on one dimension at a time."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.regression.exact import exact_roots
from fleet_slip.regression.exact.elimination import Elimination, eliminate
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import LinearModel, dependence, fit_leading, moments
from fleet_slip.regression.inference.standard_errors import noise_variance


@dataclass(frozen=True)
class OrthogonalResponses:
    """Signed lengths of the label along the orthogonal directions, in units of the noise.

    Attributes:
        order: the k signals.
        responses: a_0 of the constant, then a_1..a_k; A_j = a_j^2. Shape (k+1,).
        gram: of the order and the label.
        triangle: its elimination.
    """

    order: tuple[str, ...]
    responses: FloatArray
    gram: Gram
    triangle: Elimination

    @classmethod
    def of(cls, gram: Gram, order: Sequence[str], label: str) -> "OrthogonalResponses":
        """Rotate a Gram into an order. Raises `DataError` if dependent or without noise."""
        part = gram.restrict([*order, label])
        triangle = eliminate(moments(part))
        if triangle.singular is not None:
            raise DataError(dependence(part, order))
        variance = noise_variance(fit_leading(part, triangle, len(order)))
        if variance == 0:
            raise DataError(f"{label} has no noise around {', '.join(order)}: nothing to shrink.")
        n = part.n
        a = [exact_roots.signed_ratio(Fraction(part.sums[-1]), n * variance)]
        for t, row in enumerate(triangle.rows):
            # Row t of the Cholesky factor of n S is row / sqrt(minor_t minor_{t+1}).
            scale = n * variance * triangle.minors[t] * triangle.minors[t + 1]
            a.append(exact_roots.signed_ratio(Fraction(row[-1]), scale))
        return cls(tuple(order), np.array(a), part, triangle)

    def model(self, shrunk: FloatArray) -> LinearModel:
        """Return the model of counts whose responses are `shrunk`, shape (k+1,).

        With R the triangular factor, R b = sigma a~. Each equation of the exact triangular system
        is scaled by a~_j / a_j; so a~ = a gives least squares exactly, and zeros at the end give
        a smaller nested model. Signals with a zero coefficient drop out.
        """
        factors = [
            Fraction(float(new / old)) if old else Fraction(0)
            for new, old in zip(shrunk, self.responses, strict=True)
        ]
        b = [Fraction(0)] * len(self.order)
        for i in reversed(range(len(b))):
            row = self.triangle.rows[i]
            right = row[-1] * factors[i + 1]
            right -= sum(row[j - i] * b[j] for j in range(i + 1, len(b)))
            b[i] = right / row[0]
        explained = sum(x * s for x, s in zip(b, self.gram.sums, strict=False))
        intercept = (self.gram.sums[-1] * factors[0] - explained) / self.gram.n
        used = [i for i, x in enumerate(b) if x != 0]
        return LinearModel(
            tuple(self.order[i] for i in used),
            self.gram.signals[-1],
            tuple(b[i] for i in used),
            intercept,
        )
