"""Data that is made once, for all tests and all test processes."""

import os
import shutil
from collections.abc import Callable, Iterable
from functools import cache, wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from numba.core.caching import NullCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from fleet_slip import compiling
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse

_results: dict[Path, frozenset[Path]] = {}
"""The files that are committed and published in each."""


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that the first process to ask for it makes, while the others wait."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    result, begun = shared / name, shared / f"{name}-begun"
    with LocalFolder(shared).exclusive(f"{name}.lock", lambda: None):
        if not result.exists():
            shutil.rmtree(begun, ignore_errors=True)  # of a process that was killed
            make(begun)
            begun.rename(result)
    _results.setdefault(result, _landed(result))
    return result


def filled_once(fill: Callable[[Warehouse], object]) -> Callable[[Warehouse], Warehouse]:
    """Fill a warehouse once in each process; every one that is asked for is a copy."""

    @cache
    def filled_folder() -> TemporaryDirectory[str]:
        folder = TemporaryDirectory()
        fill(Warehouse(LocalFolder(Path(folder.name))))
        return folder

    @wraps(fill)
    def copy(warehouse: Warehouse) -> Warehouse:
        shutil.copytree(filled_folder().name, str(warehouse.root), dirs_exist_ok=True)
        return warehouse

    return copy


def compile_once() -> None:
    """Let one process compile a kernel while others wait, which then read its code.

    Its checksums are there at once, so that commands in processes of their own read it, too.
    """
    compile_anew = Dispatcher.compile

    def compile_or_read(self: Any, signature: Any) -> Any:
        if isinstance(self._cache, NullCache) or signature in self.overloads:
            return compile_anew(self, signature)
        place, missed = Path(self._cache.cache_path), self.stats.cache_misses.copy()
        lock = f"{self.py_func.__name__}.lock"
        with global_compiler_lock, LocalFolder(place).exclusive(lock, lambda: None):
            code = compile_anew(self, signature)
            if self.stats.cache_misses != missed:
                compiling._write_checksums(place.parent, {})
        return code

    setattr(Dispatcher, "compile", compile_or_read)  # noqa: B010 - mypy takes it for a method


def require_no_failed_run(root: object) -> None:
    """Fail if a command failed in a data root that is made once: `status` tells others of it."""
    if Path(str(root)) in _results:
        for file in Path(str(root), "runs").glob("*.jsonl"):
            failed = '"outcome":"failed"' in file.read_text(encoding="utf-8")
            assert not failed, f"a command failed in {root}, which other tests use. Copy it first."


def require_unchanged(roots: Iterable[object]) -> None:
    """Fail if anything was committed or published in a data root that is made once."""
    for root in roots:
        if isinstance(root, Path) and root in _results:
            before, _results[root] = _results[root], _landed(root)  # told once
            new = _results[root] - before
            assert not new, f"{min(new)} is new, and other tests use {root}. Copy it first."


def _landed(root: Path) -> frozenset[Path]:
    return frozenset([*root.glob("*/_delta_log/*.json"), *root.glob("models/**/*.json")])
