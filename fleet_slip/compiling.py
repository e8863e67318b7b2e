"""How the functions of this package are compiled: to the same bits on every machine."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

from fleet_slip.base import missing
from fleet_slip.caches import code_folder

try:
    import llvmlite
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

Without `fastmath` nothing is reordered or fused, and IEEE 754 rounds what is used in one way:
additions, multiplications, divisions, roots, comparisons. Divisions by zero do not branch.
"""

inner_loop = _compiler(nogil=True, error_model="numpy")
"""Compiles a loop that compiled code calls, to the same bits as an equation."""

_kept_loop = _compiler(nogil=True, error_model="numpy", cache=True)

exact_loop = _compiler(nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
"""Compiles a loop over integers below 2^53, products and sums too: exact in any order."""


def kernel(function: Function) -> Function:
    """Compile a function that is called from Python, without the GIL.

    numba keeps the code in a folder that this user alone can write, if there is one (`caches`).
    """
    folder = code_folder(f"{numba.__version__} {llvmlite.__version__}") if numba else None
    if folder is None:
        return inner_loop(function)
    config: Any = numba.config
    usual = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
    config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = str(folder), "UserProvidedCacheLocator"
    try:
        return _kept_loop(function)
    except RuntimeError:  # of no source file, as those that are typed
        return inner_loop(function)
    finally:
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = usual
