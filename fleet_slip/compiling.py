"""How the functions of this package are compiled: to the same bits on every machine."""

import contextlib
import functools
import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache, NullCache

LOGGER = logging.getLogger("fleet_slip")

Function = TypeVar("Function", bound=Callable[..., Any])

equation = numba.njit(error_model="numpy", forceinline=True)
"""Compiles a pure function that is inlined where it is called, so that loops over lanes vectorise.

Without `fastmath` the compiler neither reorders nor fuses operations, and of floating point only
additions, multiplications, divisions, square roots, comparisons and selections are used, which
IEEE 754 rounds in one way. Division by zero gives an infinity, not an exception that would put a
branch in the loop.
"""


def kernel(function: Function) -> Function:
    """Compile a function that is called from Python, without the GIL.

    The compiled code is kept on disk: in $NUMBA_CACHE_DIR, beside the source, or in the user's
    cache folder. Where none of these can be written, every process compiles anew, and a remark says
    so. It is never kept in a data root: to load it is to execute it, and others may write there.
    """
    compiled: Any = numba.njit(nogil=True, error_model="numpy")(function)
    try:
        compiled._cache = _KeptCode(function)  # type: ignore[no-untyped-call]
    except RuntimeError:  # numba found no folder
        compiled._cache = _NoFolder()
    return cast(Function, compiled)


class _KeptCode(FunctionCache):
    """Compiled code on disk. A full disk or a damaged file costs the time to compile, no more."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for a signature, None if there is none that can be used."""
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception as error:
            _remark(f"{self.cache_path}: the compiled code is damaged ({type(error).__name__})")
            with contextlib.suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for a signature if the disk takes it."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            _remark(f"{self.cache_path}: compiled code cannot be kept ({error.strerror})")


class _NoFolder(NullCache):
    """No place for compiled code."""

    def save_overload(self, sig: Any, cres: Any) -> None:  # noqa: ARG002
        """Keep nothing, and say so."""
        _remark("there is no folder where compiled code can be kept")


@functools.cache
def _remark(what: str) -> None:
    LOGGER.warning(
        "%s: it is compiled anew, which takes seconds every time. Set NUMBA_CACHE_DIR to a folder "
        "that this user alone can write.",
        what,
    )
