"""Finds the SQL and TOML files that ship with the package, from a wheel or from a checkout."""

from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Literal

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


def config_names(kind: str) -> list[str]:
    """Return the names of the shipped configs of one kind, such as `campaigns`, sorted."""
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in (folder("configs") / kind).iterdir()
        if entry.name.endswith(".toml")
    )


def find_config(kind: str, name_or_path: str) -> Traversable:
    """Return a config file: a path if it looks like one, else a shipped config of that name.

    Raises `ConfigError` if there is neither, naming the shipped ones.
    """
    if name_or_path.endswith(".toml") or "/" in name_or_path:
        path = Path(name_or_path)
        if _is_file(path):
            return path
        raise ConfigError(f"{path}: no such file. Give the path of a {kind} TOML file.")
    file = folder("configs") / kind / f"{name_or_path}.toml"
    if _is_file(file):
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
