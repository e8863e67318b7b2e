"""Compilation by numba, with the same bits on every machine.

The cache of compiled code must be writable by this user alone: its files are executed.
"""

import atexit
import functools
import json
import logging
import os
import re
import shutil
import stat
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite
import numba

from fleet_slip.resources import cache_folder

LOGGER = logging.getLogger("fleet_slip")

PACKAGE = Path(__file__).parent

CHECKSUMS = "checksums.json"
LEAST_FREE_BYTES = 2**25
PREFIX = "fleet-slip-"
MAX_FOLDERS = 128
"""Folders of compiled code to retain, last used first. One state of the sources needs about 20."""

_IMPORT = re.compile(
    rb"^\s*(?:from|import) +fleet_slip\b([\w.]*)(?: +import +(\w+) *$)?", re.MULTILINE
)

Function = TypeVar("Function", bound=Callable[..., Any])


def _compiler(**options: Any) -> Callable[[Function], Function]:
    def compile_later(function: Function) -> Function:
        return cast(Function, numba.njit(**options)(function))

    return compile_later


equation = _compiler(error_model="numpy", forceinline=True)
"""Compiles a pure function that is inlined into its callers, so that loops over lanes vectorise.

Without `fastmath` nothing is reordered or fused, and IEEE 754 determines the result of additions,
multiplications, divisions, roots and comparisons. Divisions by zero do not branch.
"""

inner_loop = _compiler(nogil=True, error_model="numpy")
"""Compiles a loop for callers that are compiled, with the same arithmetic as `equation`."""

_kept_loop = _compiler(nogil=True, error_model="numpy", cache=True)


def kernel(function: Function) -> Function:
    """Compile a function for callers in Python; it releases the GIL.

    numba caches the code if there is a folder that only this user can write.
    """
    file = Path(cast(Any, function).__code__.co_filename)
    folder = code_folder(digest_sources(file)) if file.is_file() else None
    if folder is None:  # such as for a function typed at a prompt
        return inner_loop(function)
    config: Any = numba.config
    usual = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
    config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = str(folder), "UserProvidedCacheLocator"
    try:
        return _kept_loop(function)
    finally:
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = usual


@functools.cache
def code_folder(digest: str) -> Path | None:
    """Return the folder of compiled code for sources with a digest, without damaged files.

    Returns None and logs a warning if there is none that only this user can write.
    """
    chosen = os.environ.get(
        "NUMBA_CACHE_DIR"
    )  # numba's own variable; read when a module is imported
    try:
        base = Path(chosen or cache_folder("compiled")).resolve()
        folder = base / f"{PREFIX}{digest}"
        new = not folder.is_dir()
        for parent in reversed([folder, *folder.parents]):
            if not parent.is_dir():
                parent.mkdir(0o700, exist_ok=True)
        _require_own(folder)
    except OSError as error:
        LOGGER.warning(
            "compiled code cannot be cached (%s): each command compiles again, which takes "
            "seconds. Set NUMBA_CACHE_DIR to a folder that only this user can write.",
            error,
        )
        return None
    os.utime(folder)  # used now: older ones are deleted first
    sums = _delete_damaged(folder)
    atexit.register(_write_checksums, folder, sums)
    for old in sorted(base.glob(f"{PREFIX}*"), key=os.path.getmtime)[:-MAX_FOLDERS] if new else ():
        shutil.rmtree(old, ignore_errors=True)
    return folder


def digest_sources(file: Path) -> str:
    """Return a digest of the compiler, a file and, recursively, the modules that it imports."""
    sources: set[Path] = set()
    waiting = [file]
    while waiting:
        module = waiting.pop()
        if module not in sources:
            sources.add(module)
            waiting += _imported(module)
    digest = sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for source in sorted(sources):
        digest.update(sha256(source.read_bytes()).digest())
    return digest.hexdigest()[:32]


@functools.cache
def _imported(file: Path) -> list[Path]:
    """Return the modules of this package that a file imports; all of an imported folder."""
    sources: list[Path] = []
    for package, name in _IMPORT.findall(file.read_bytes()):
        place = PACKAGE.joinpath(*package.decode().split("."))
        modules = [place.with_suffix(".py"), place / f"{name.decode()}.py"]
        sources += next(([module] for module in modules if module.is_file()), place.rglob("*.py"))
    return sources


def _require_own(folder: Path) -> None:
    """Raise `OSError` if other users can write or replace a folder, or if its disk is full."""
    for parent in (folder, *folder.parents):
        status = parent.stat(follow_symlinks=False)
        if parent == folder:
            safe = status.st_uid == os.getuid() and not status.st_mode & 0o022
        else:  # in a sticky folder such as /tmp, only owners can rename
            by_others = status.st_mode & 0o022 and not status.st_mode & stat.S_ISVTX
            safe = status.st_uid in (os.getuid(), 0) and not by_others
        if not safe:
            raise PermissionError(f"other users can write {parent}")
    space = os.statvfs(folder)
    if space.f_bavail * space.f_frsize < LEAST_FREE_BYTES or not os.access(folder, os.W_OK):
        raise OSError(f"{folder} cannot be written, or its disk is full")


def _delete_damaged(folder: Path) -> dict[str, str]:
    """Delete damaged files; return the checksums of the others.

    numba renames files without flushing them, so a power cut can damage them.
    """
    checksums = {}
    with suppress(OSError, ValueError):
        checksums = dict(json.loads((folder / CHECKSUMS).read_bytes()))
    sums = _checksums(folder)
    for name in sums.keys() - dict(sums.items() & checksums.items()).keys():
        (folder / name).unlink(missing_ok=True)
        del sums[name]
    return sums


def _write_checksums(folder: Path, before: dict[str, str]) -> None:
    with suppress(OSError):
        if (sums := _checksums(folder)) != before:
            draft = folder / f"{CHECKSUMS}.{os.getpid()}"
            draft.write_text(json.dumps(sums))
            draft.replace(folder / CHECKSUMS)


def _checksums(folder: Path) -> dict[str, str]:
    checksums = {}
    for file in folder.glob("*/*.nb[ic]"):
        with suppress(FileNotFoundError):  # of another process
            checksums[str(file.relative_to(folder))] = sha256(file.read_bytes()).hexdigest()
    return checksums
