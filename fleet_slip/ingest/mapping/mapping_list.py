"""Which mapping the logs of a folder go through: one all of them, or several each its own."""

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from pydantic import Field

from fleet_slip.config import Config, Name, load_config, load_toml
from fleet_slip.errors import UnclaimedError
from fleet_slip.ingest.logs.log_files import Log, Place, is_pattern, is_url, names_several
from fleet_slip.ingest.mapping.mapping import Mapping, load_mapping
from fleet_slip.resources import find_config
from fleet_slip.words import number_of, shown

NAMES_SHOWN = 3


class ListedMapping(Config):
    """Which files of a folder go through a mapping; without one they are left alone."""

    files: Name
    """A folder in it, a pattern of names at any depth, or, with `/`, of paths below it."""
    mapping: Name | None = None
    """A name, or the path of a TOML file, seen from the list's own."""


class ListFile(Config):
    """A TOML file that lists mappings."""

    mappings: tuple[ListedMapping, ...] = Field(min_length=1)


@dataclass(frozen=True)
class Entry:
    """Files, and the mapping that they go through, None if they are left alone."""

    files: str
    mapping: Mapping | None

    def takes(self, name: str) -> bool:
        """Whether a path below the folder is among the files."""
        seen = name if "/" in self.files else name.rpartition("/")[2]
        return fnmatchcase(seen, self.files) or name.startswith(f"{self.files.rstrip('/')}/")


@dataclass(frozen=True)
class MappingList:
    """Mappings, each of which takes files of its own."""

    name: str
    entries: tuple[Entry, ...]

    def share_out(
        self, logs: Sequence[Log], places: Iterable[Place]
    ) -> tuple[list[tuple[Mapping, list[Log]]], UnclaimedError | None]:
        """Return the logs of each mapping, and what tells of those of none or of several.

        Patterns are seen from the `places` in which the logs were found.
        """
        folders = sorted(map(_folder_of, places), key=len)
        shares: list[list[Log]] = [[] for _ in self.entries]
        none, several = list[str](), list[str]()
        for log in logs:
            name = _name_below(folders, log)
            takers = [n for n, one in enumerate(self.entries) if one.takes(name)]
            if len(takers) == 1:
                shares[takers[0]].append(log)
            else:
                (several if takers else none).append(name)
        taken = [
            (one.mapping, share)
            for one, share in zip(self.entries, shares, strict=True)
            if one.mapping is not None and share
        ]
        left_out = [
            f"{_told(n)} of {of}"
            for n, of in ((none, "no mapping"), (several, "several mappings"))
            if n
        ]
        if not left_out:
            return taken, None
        return taken, UnclaimedError(
            f"{self.name}: {' and '.join(left_out)} left out. Give each file one mapping in it, or "
            "none, and it is left alone."
        )


def _told(names: list[str]) -> str:
    """Return how many logs they are, and the first of them."""
    more = ", …" if len(names) > NAMES_SHOWN else ""
    listed = ", ".join(map(shown, names[:NAMES_SHOWN]))
    return f"{number_of(len(names), 'log')} ({listed}{more})"


def as_list(mapping: str | Mapping | MappingList) -> MappingList:
    """Return what a name, a path, a mapping or a list stands for. Raises `ConfigError`.

    A file with `[[mappings]]` is a list; any other is the mapping of all logs.
    """
    if isinstance(mapping, MappingList):
        return mapping
    if isinstance(mapping, Mapping):
        return MappingList(mapping.name, (Entry("*", mapping),))
    file = find_config("mappings", mapping)
    if "mappings" not in load_toml(file):
        return as_list(load_mapping(mapping))
    folder = Path(str(file)).parent
    return MappingList(
        mapping,
        tuple(
            Entry(one.files, _listed(one.mapping, folder))
            for one in load_config(file, ListFile).mappings
        ),
    )


def _listed(mapping: str | None, folder: Path) -> Mapping | None:
    if mapping is None:
        return None
    return load_mapping(str(folder / mapping) if mapping.endswith(".toml") else mapping)


def _folder_of(place: Place) -> str:
    """Return the folder that is searched, with `/` at its end."""
    text = str(place) if is_url(place) else os.path.abspath(place)  # noqa: PTH100 - as in a URL
    if is_pattern(place if is_url(place) else Path(place)):
        text = re.split(r"[*?[]", text, maxsplit=1)[0]
    elif names_several(place):
        return f"{text.rstrip('/')}/"
    return f"{text.rpartition('/')[0]}/"


def _name_below(folders: Sequence[str], log: Log) -> str:
    """Return the path of a log below the outermost of the folders that have it."""
    text = os.path.abspath(log) if isinstance(log, Path) else str(log)  # noqa: PTH100
    inside = (text[len(folder) :] for folder in folders if text.startswith(folder))
    return next(inside, text.rpartition("/")[2])
