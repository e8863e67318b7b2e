"""Keeps compiled code from one process to the next, and checks it when it is read.

numba 0.68 lets others say where code is kept and its stamp (`NUMBA_CACHE_LOCATOR_CLASSES`), not how
files are read and written; so its classes, which are not public, are extended here.
"""

import contextlib
import functools
import hashlib
import logging
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache
from numba.core.serialize import dumps

LOGGER = logging.getLogger("fleet_slip")

DIGEST_BYTES = hashlib.sha256().digest_size

PACKAGE = Path(__file__).parent

COMPILING = PACKAGE / "compiling.py"

_IMPORTS = re.compile(rf"^\s*from ({PACKAGE.name}[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
_WORD = re.compile(r"\w+")


def keep(compiled: Any, function: Callable[..., Any]) -> None:
    """Let the code of a compiled function be kept, and be read if it was."""
    try:
        compiled._cache = _KeptCode(function)
    except RuntimeError:  # numba found no folder
        compiled._cache = _NoFolder()


class _KeptCode(FunctionCache):
    """Compiled code on disk. A full disk or a damaged file costs the time to compile, no more."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file = _CheckedFiles(  # type: ignore[no-untyped-call]
            self.cache_path,
            f"{self._impl.filename_base}.checked",
            (self._impl.locator.get_source_stamp(), _sources_stamp(function.__code__.co_filename)),
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for a signature, None if there is none that can be used."""
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except _USELESS as error:
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


@functools.cache
def _sources_stamp(file: str) -> str:
    """Return a checksum of a source file, of those that it imports, and of how it is compiled."""
    digest = hashlib.sha256()
    for source in sorted({*_sources_of(Path(file)), Path(__file__), COMPILING}):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _sources_of(file: Path) -> set[Path]:
    found, waiting = set[Path](), [file]
    while waiting:
        source = waiting.pop()
        if source not in found and source.exists():
            found.add(source)
            for module, names in _IMPORTS.findall(source.read_text(encoding="utf-8")):
                base = PACKAGE.parent / module.replace(".", "/")
                waiting.append(base.with_suffix(".py"))
                waiting += [base / f"{name}.py" for name in _WORD.findall(names)]
    return found


class _DamagedCodeError(Exception):
    """A file of compiled code is not what was written."""


_USELESS = (_DamagedCodeError, ImportError, AttributeError, RuntimeError)
"""What loading raises at a damaged file, a name that is gone, and code that LLVM does not read."""


class _CheckedFiles(IndexDataCacheFile):
    """Files that begin with the checksum of the rest, lest a flipped bit be executed."""

    def _save_index(self, overloads: Any) -> None:
        stamped = dumps((self._source_stamp, overloads))  # type: ignore[no-untyped-call]
        self._save_data(self._index_name, (self._version, stamped))  # type: ignore[no-untyped-call]

    def _load_index(self) -> Any:
        try:
            version, stamped = self._load_data(self._index_name)
        except FileNotFoundError:
            return {}
        if version != self._version:  # of numba: the rest may name what it does not have
            return {}
        stamp, overloads = pickle.loads(stamped)  # noqa: S301 - as far as numba's own trust goes
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()  # type: ignore[no-untyped-call]
        digest, pickled = content[:DIGEST_BYTES], content[DIGEST_BYTES:]
        if hashlib.sha256(pickled).digest() != digest:
            raise _DamagedCodeError(name)
        return pickle.loads(pickled)  # noqa: S301 - of the user's own folder, and undamaged

    def _dump(self, obj: Any) -> bytes:
        pickled: bytes = super()._dump(obj)  # type: ignore[no-untyped-call]
        return hashlib.sha256(pickled).digest() + pickled


class _NoFolder(NullCache):
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
