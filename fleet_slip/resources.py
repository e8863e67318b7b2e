"""Find `configs/`, `jobs/` and `warehouse/`, installed or not, and folders of this user."""

import json
import os
from contextlib import suppress
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal

from fleet_slip.errors import ConfigError

CONFIG_VARIABLE = "FLEET_SLIP_CONFIG"
"""Names a folder of configs that is laid over the shipped ones."""

CONFIG_FILES = (
    "blind.toml",
    "signals.toml",
    "features.toml",
    "monitor.toml",
    "publish.toml",
    "retention.toml",
)

CONFIG_FOLDERS = ("campaigns", "mappings", "models", "scenarios", "tracks", "vehicles")


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


def own_configs() -> Path | None:
    """Return the folder of configs laid over those shipped. Raises `ConfigError` if unusable."""
    chosen = os.environ.get(CONFIG_VARIABLE)
    if not chosen:
        return None
    folder_of_own = Path(chosen)
    if not folder_of_own.is_dir():
        raise ConfigError(f"{chosen}: no such folder of configs.")
    for place in (folder_of_own, *(folder_of_own / kind for kind in CONFIG_FOLDERS)):
        # What cannot be looked into would count as empty, and the shipped configs would be used.
        if os.path.lexists(place) and not (place.is_dir() and os.access(place, os.R_OK | os.X_OK)):
            raise ConfigError(f"{place}: not a folder that can be read.")
    for file in sorted(folder_of_own.rglob("*.toml")):
        _require_kind(file.relative_to(folder_of_own).as_posix(), file)
    return folder_of_own


def _require_kind(name: str, file: Path) -> None:
    kind, _, rest = name.rpartition("/")
    if kind not in CONFIG_FOLDERS if kind else rest not in CONFIG_FILES:
        raise ConfigError(
            f"{file}: no config of fleet-slip. A folder of configs has {', '.join(CONFIG_FILES)}, "
            f"and TOML files in {', '.join(CONFIG_FOLDERS)}."
        )


def config_file(name: str) -> Traversable:
    """Return a config file such as `monitor.toml`: one's own, even a broken link, or ours."""
    own = own_configs()
    return own / name if own and os.path.lexists(own / name) else folder("configs") / name


def config_files() -> dict[str, Traversable]:
    """Return every config file that is in force, by its name below the folder of configs."""
    names = [
        *CONFIG_FILES,
        *(f"{kind}/{name}.toml" for kind in CONFIG_FOLDERS for name in config_names(kind)),
    ]
    return {name: config_file(name) for name in names}


def config_names(kind: str) -> list[str]:
    """Return the names of the configs of one kind, such as `campaigns`, sorted."""
    own = own_configs()
    folders = [folder("configs") / kind, *([own / kind] if own else [])]
    return sorted(
        {
            entry.name.removesuffix(".toml")
            for one in folders
            if one.is_dir()
            for entry in one.iterdir()
            if entry.name.endswith(".toml")
        }
    )


def find_config(kind: str, name_or_path: str) -> Traversable:
    """Return a config file by path or name. Raises `ConfigError`, naming those that there are."""
    if name_or_path.endswith(".toml") or "/" in name_or_path:
        path = Path(name_or_path)
        if _is_file(path):
            return path
        raise ConfigError(f"{path}: no such file. Give the path of a TOML file.")
    file = config_file(f"{kind}/{name_or_path}.toml")
    if _is_file(file) or os.path.islink(str(file)):  # noqa: PTH114 - see `config_file`
        return file
    known = ", ".join(config_names(kind))
    raise ConfigError(
        f"{kind}: nothing is called {name_or_path!r}. Known: {known}; or give the path of a TOML "
        "file."
    )


def _is_file(path: Traversable) -> bool:
    """Whether there is such a file; a name that the system cannot have names none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def cache_folder(name: str) -> Path:
    """Return a folder of this user for what can be lost."""
    service = os.environ.get("CACHE_DIRECTORY", "").partition(":")[0]
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    return Path(service or Path(home, "fleet-slip"), name)


def keep_json(file: Path, content: Any) -> None:
    """Write JSON to a file of a cache, whole; what cannot be written is not kept."""
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        draft = file.with_suffix(f".{os.getpid()}")
        draft.write_text(json.dumps(content))
        draft.replace(file)
