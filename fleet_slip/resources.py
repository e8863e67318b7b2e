"""Locations of the shipped files and of the user's configs and cache; memory of this process."""

import json
import os
import resource
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal

from fleet_slip.errors import ConfigError

ShippedFolder = Literal["configs", "jobs", "warehouse"]


def folder(name: ShippedFolder) -> Traversable:
    """Return the folder `configs`, `jobs` or `warehouse` of this installation."""
    packaged = files("fleet_slip") / "_data" / name
    if packaged.is_dir():
        return packaged
    return Path(str(files("fleet_slip"))).parent / name


def read_sql(name: ShippedFolder, file: str) -> str:
    """Return the text of one SQL file, such as `read_sql("jobs", "gram.sql")`."""
    return (folder(name) / file).read_text(encoding="utf-8")


CONFIG_FILES = sorted(e.name for e in folder("configs").iterdir() if e.name.endswith(".toml"))
CONFIG_FOLDERS = sorted(e.name for e in folder("configs").iterdir() if e.is_dir())


@dataclass(frozen=True)
class Configs:
    """Configuration files: the shipped ones, and a folder of the user's laid over them.

    Parameters
    ----------
    folder
        Folder with the user's files, laid out like `configs/`; None for the shipped files alone.

    Raises
    ------
    ConfigError
        If the folder does not exist, cannot be read, or contains a file that is no configuration.
    """

    folder: Path | None = None

    def __post_init__(self) -> None:
        if self.folder is None:
            return
        if not self.folder.is_dir():
            raise ConfigError(f"{self.folder}: no such folder of configs.")
        for place in (self.folder, *(self.folder / kind for kind in CONFIG_FOLDERS)):
            # An unreadable folder would count as empty, and the shipped files would be used.
            readable = place.is_dir() and os.access(place, os.R_OK | os.X_OK)
            if os.path.lexists(place) and not readable:
                raise ConfigError(f"{place}: not a folder that can be read.")
        for file in sorted(self.folder.rglob("*.toml")):
            kind, _, base = file.relative_to(self.folder).as_posix().rpartition("/")
            if kind not in CONFIG_FOLDERS if kind else base not in CONFIG_FILES:
                raise ConfigError(
                    f"{file}: no config of fleet-slip. A folder of configs has "
                    f"{', '.join(CONFIG_FILES)}, and TOML files in {', '.join(CONFIG_FOLDERS)}."
                )

    def file(self, name: str) -> Traversable:
        """Return a file such as `monitor.toml`: the user's, even a broken link, or the shipped."""
        if self.folder and os.path.lexists(self.folder / name):
            return self.folder / name
        return folder("configs") / name

    def files(self) -> dict[str, Traversable]:
        """Return every configuration file in force, by its name below the folder."""
        of_kinds = (f"{kind}/{name}.toml" for kind in CONFIG_FOLDERS for name in self.names(kind))
        return {name: self.file(name) for name in (*CONFIG_FILES, *of_kinds)}

    def names(self, kind: str) -> list[str]:
        """Return the names of the files of one kind, such as `campaigns`, sorted."""
        folders = [folder("configs") / kind, *([self.folder / kind] if self.folder else [])]
        names = {e.name for place in folders if place.is_dir() for e in place.iterdir()}
        return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))

    def find(self, kind: str, name_or_path: str) -> Traversable:
        """Return a file by path or name. Raises `ConfigError` that lists the existing names."""
        if name_or_path.endswith(".toml") or "/" in name_or_path:
            path = Path(name_or_path)
            if _is_file(path):
                return path
            raise ConfigError(f"{path}: no such file. Give the path of a TOML file.")
        file = self.file(f"{kind}/{name_or_path}.toml")
        if _is_file(file) or os.path.islink(str(file)):  # noqa: PTH114 - see `file`
            return file
        names = ", ".join(self.names(kind))
        raise ConfigError(
            f"{kind}: no file {name_or_path!r}. Known: {names}; or give the path of a TOML file."
        )


SHIPPED_CONFIGS = Configs()
"""The shipped configuration files alone."""


def _is_file(path: Traversable) -> bool:
    """Return True if the file exists, False for names that the system does not allow."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def cache_folder(name: str) -> Path:
    """Return a cache folder of this user.

    Reads the system's variables, as modules need the folder for compiled code when they are
    imported.
    """
    service = os.environ.get("CACHE_DIRECTORY", "").partition(":")[0]
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    return Path(service or Path(home, "fleet-slip"), name)


def keep_json(file: Path, content: Any) -> None:
    """Write JSON atomically to a file of a cache; ignore errors."""
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        draft = file.with_suffix(f".{os.getpid()}")
        draft.write_text(json.dumps(content))
        draft.replace(file)


# Memory limits of this process.

CGROUPS = Path("/sys/fs/cgroup")
OWN_CGROUP = Path("/proc/self/cgroup")

LIBRARIES_BYTES = 7 * 2**29
"""Address space that the libraries reserve; they use little of it."""
THREAD_BYTES = 2**28
"""Address space per processor: stacks and heaps of the libraries' threads."""
DATA_BYTES = 2**30
"""Private memory, as `ulimit -d` counts it, that the libraries need to start and end."""
DATA_THREAD_BYTES = 2**26
"""Private memory per processor that the libraries need."""


def memory_bytes() -> int:
    """Return the memory for data: the least of the machine's, the control group's and limits."""
    allowed = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), *_cgroup_limits()]
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if address_space != resource.RLIM_INFINITY:
        allowed.append(max(address_space - LIBRARIES_BYTES, THREAD_BYTES))
    _, data = resource.getrlimit(resource.RLIMIT_DATA)  # the soft limit may be our own
    if data != resource.RLIM_INFINITY:
        allowed.append(max(data - DATA_BYTES // 2, THREAD_BYTES))
    return min(allowed)


def data_needed() -> int:
    """Return the smallest `ulimit -d` under which the libraries work."""
    return DATA_BYTES + DATA_THREAD_BYTES * len(os.sched_getaffinity(0))


def find_low_limit() -> str | None:
    """Return a text about a limit of the shell under which libraries abort or hang, else None."""
    needed = {
        "-v": (resource.RLIMIT_AS, LIBRARIES_BYTES + THREAD_BYTES * len(os.sched_getaffinity(0))),
        "-d": (resource.RLIMIT_DATA, data_needed()),
    }
    for option, (limit, least) in needed.items():
        hard = resource.getrlimit(limit)[1]
        if hard != resource.RLIM_INFINITY and hard < least:
            return (
                f"ulimit {option} is {hard // 2**10} KiB, and the libraries need "
                f"{least // 2**10} KiB. Raise the limit, or limit the control group instead."
            )
    return None


def _cgroup_limits() -> Iterator[int]:
    """Yield the memory limits of this process's control group (version 2) and its parents.

    In a container the path may be the host's, and the limit at the top.
    """
    with suppress(OSError):
        path = OWN_CGROUP.read_text(encoding="utf-8").strip().rpartition("::")[2]
        group = CGROUPS / path.lstrip("/")
        for folder in (group, *group.parents):
            with suppress(OSError, ValueError):
                yield int((folder / "memory.max").read_text(encoding="ascii"))
