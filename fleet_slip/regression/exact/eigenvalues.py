"""Eigenvalues of small symmetric matrices, the same bits on every machine, unlike LAPACK's."""

import math
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec

import numpy as np

from fleet_slip.arrays import FloatArray

MAX_SWEEPS = 60
"""Convergence is quadratic: five to ten sweeps are usual."""

MANY = 128
"""From so many rows on, compiled code saves more than loading it takes."""

_UNIT_ROUNDOFF = 2.0**-53


def symmetric_eigenvalues(matrix: FloatArray) -> list[float]:
    """Return the eigenvalues of a symmetric matrix, shape (k, k), ascending.

    Cyclic Jacobi rotations (Golub and Van Loan, section 8.5) with relative stopping, by which small
    eigenvalues of positive definite matrices are accurate (Demmel and Veselic 1992).
    """
    a = np.array(matrix, dtype=np.float64)
    sweep = _compiled_sweep() if len(a) >= MANY else _sweep
    for _ in range(MAX_SWEEPS):
        if not sweep(a):
            break
    return sorted(a.diagonal().tolist())


def _sweep(a: FloatArray) -> int:
    """Make each a[p, q] zero in turn, but what is small already; return how many were not."""
    rotations = 0
    for q in range(len(a)):
        for p in range(q):
            app, aqq, apq = a[p, p], a[q, q], a[p, q]
            if abs(apq) <= _UNIT_ROUNDOFF * math.sqrt(abs(app)) * math.sqrt(abs(aqq)):
                continue
            rotations += 1
            cotangent = (aqq - app) / (2 * apq)
            root = math.sqrt(cotangent * cotangent + 1)
            tangent = math.copysign(1 / (abs(cotangent) + root), cotangent)
            cosine = 1 / math.sqrt(tangent * tangent + 1)
            sine = tangent * cosine
            row_p, row_q = a[p].copy(), a[q].copy()
            a[p] = cosine * row_p - sine * row_q
            a[q] = sine * row_p + cosine * row_q
            a[:, p], a[:, q] = a[p], a[q]
            a[p, p], a[q, q] = app - tangent * apq, aqq + tangent * apq
            a[p, q] = a[q, p] = 0.0
    return rotations


@cache
def _compiled_sweep() -> Callable[[FloatArray], int]:
    """Return the same as compiled code, of the same bits; where nothing compiles, as it is."""
    if find_spec("numba") is None:
        return _sweep
    from fleet_slip.compiling import kernel  # noqa: PLC0415 - slow

    return kernel(_sweep)
