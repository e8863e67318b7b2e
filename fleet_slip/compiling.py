"""How the functions of this package are compiled: to the same bits on every machine."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

from fleet_slip.extras import missing

try:
    import numba
except ModuleNotFoundError:  # of an extra: what is compiled says so when it is called
    numba = None  # type: ignore[assignment]

Function = TypeVar("Function", bound=Callable[..., Any])


def _compiler(**options: Any) -> Callable[[Function], Function]:
    def compile_later(function: Function) -> Function:
        return cast(Function, numba.njit(**options)(function) if numba else _refusing(function))

    return compile_later


def _refusing(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return what stands for a function that cannot be compiled here."""

    @functools.wraps(function)
    def refuse(*_: Any, **__: Any) -> Any:
        raise missing("compiled", "this runs as compiled code, which", "numba")

    return refuse


equation = _compiler(error_model="numpy", forceinline=True)
"""Compiles a pure function that is inlined where it is called, so that loops over lanes vectorise.

Without `fastmath` the compiler neither reorders nor fuses operations, and of floating point only
additions, multiplications, divisions, square roots, comparisons and selections are used, which
IEEE 754 rounds in one way. Division by zero gives an infinity, not an exception that would put a
branch in the loop.
"""

inner_loop = _compiler(nogil=True, error_model="numpy")
"""Compiles a loop that compiled code calls, to the same bits as an equation."""

exact_loop = _compiler(nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
"""Compiles a loop over integers whose every product and sum is below 2^53 in size.

They are exact in any order, so that the compiler may change the order, and fuse operations.
"""


def kernel(function: Function) -> Function:
    """Compile a function that is called from Python, without the GIL.

    The compiled code is kept on disk: in $NUMBA_CACHE_DIR, beside the source, or in the user's
    cache folder. Where none of these can be written, every process compiles anew, and a remark says
    so. It is never kept in a data root: to load it is to execute it, and others may write there.
    """
    compiled = inner_loop(function)
    if numba:
        from fleet_slip.kept_code import keep  # noqa: PLC0415 - it needs numba

        keep(compiled, function)
    return compiled
