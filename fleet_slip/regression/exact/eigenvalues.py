"""Eigenvalues of small symmetric matrices, the same bits on every machine, unlike LAPACK's."""

import math

import numpy as np

from fleet_slip.arrays import FloatArray

MAX_SWEEPS = 60
"""Convergence is quadratic: five to ten sweeps are usual."""

_UNIT_ROUNDOFF = 2.0**-53


def symmetric_eigenvalues(matrix: FloatArray) -> list[float]:
    """Return the eigenvalues of a symmetric matrix, shape (k, k), ascending.

    Cyclic Jacobi rotations (Golub and Van Loan, section 8.5) with relative stopping, by which small
    eigenvalues of positive definite matrices are accurate (Demmel and Veselic 1992).
    """
    a = np.array(matrix, dtype=np.float64)
    pairs = [(p, q) for q in range(len(a)) for p in range(q)]
    for _ in range(MAX_SWEEPS):
        rotations = sum(_rotate(a, p, q) for p, q in pairs)
        if not rotations:
            break
    return sorted(a.diagonal().tolist())


def _rotate(a: FloatArray, p: int, q: int) -> bool:
    """Make a[p, q] zero; return False if it was small already."""
    app, aqq, apq = float(a[p, p]), float(a[q, q]), float(a[p, q])
    if abs(apq) <= _UNIT_ROUNDOFF * math.sqrt(abs(app)) * math.sqrt(abs(aqq)):
        return False
    cotangent = (aqq - app) / (2 * apq)
    tangent = math.copysign(1 / (abs(cotangent) + math.sqrt(cotangent * cotangent + 1)), cotangent)
    cosine = 1 / math.sqrt(tangent * tangent + 1)
    sine = tangent * cosine
    row_p, row_q = a[p].copy(), a[q].copy()
    a[p] = a[:, p] = cosine * row_p - sine * row_q
    a[q] = a[:, q] = sine * row_p + cosine * row_q
    a[p, p], a[q, q] = app - tangent * apq, aqq + tangent * apq
    a[p, q] = a[q, p] = 0.0
    return True
