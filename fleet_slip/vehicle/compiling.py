"""How the functions of this package are compiled: to the same bits on every machine."""

from collections.abc import Callable
from typing import Any

import numba

equation = numba.njit(error_model="numpy", forceinline=True)
"""Compiles a pure function that is inlined where it is called, so that loops over lanes vectorise.

Without `fastmath` the compiler neither reorders nor fuses operations, and of floating point only
additions, multiplications, divisions, square roots, comparisons and selections are used, which
IEEE 754 rounds in one way. Division by zero gives an infinity, not an exception that would put a
branch in the loop.
"""


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that is called from Python, without the GIL.

    The compiled code is kept on disk beside the source or in the user's cache folder; where neither
    can be written, it is compiled anew by every process.
    """
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:
        return numba.njit(nogil=True, error_model="numpy")(function)
