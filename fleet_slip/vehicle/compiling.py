"""How the functions of this package are compiled: to the same bits on every machine."""

import numba

equation = numba.njit(error_model="numpy", forceinline=True)
"""Compiles a pure function that is inlined where it is called, so that loops over lanes vectorise.

Without `fastmath` the compiler neither reorders nor fuses operations, and of floating point only
additions, multiplications, divisions, square roots, comparisons and selections are used, which
IEEE 754 rounds in one way. Division by zero gives an infinity, not an exception that would put a
branch in the loop.
"""
