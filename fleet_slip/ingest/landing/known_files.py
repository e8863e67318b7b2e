"""Remembers which measured files of this machine have landed.

What is remembered is a cache, of this machine and beside no data: a file's path, size and time of
change tell its digest, so that thousands of files need not be read to find nothing new. Whether
that digest is in the warehouse is asked of the warehouse. Losing the cache costs time, and the
notice that a file has changed since it landed, so that its drives would count twice.
"""

import json
import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from fleet_slip.caches import cache_folder
from fleet_slip.delta import Snapshot
from fleet_slip.files.folder import StoredFile
from fleet_slip.ingest.landing.data_files import unit_of
from fleet_slip.ingest.logs.log_files import Log, StoredParts
from fleet_slip.ingest.mapping.mapping import Mapping
from fleet_slip.warehouse.tables import Warehouse

WITHDRAWALS = "withdrawals"
"""Unit of every commit that takes files out again, with a number that grows."""


@dataclass
class KnownFiles:
    """Which content the files of this machine had when they landed through a mapping.

    Attributes:
        digests: size, time of change (of an object, what the store calls its version) and
            digest, by absolute path or URL.
        landed: digests that are in the logs as they were at a moment: a version of the table, and
            the digest of its commit. While that commit is the table's, they need not be asked for.
    """

    cache: Path
    digests: dict[str, tuple[int, int | str, str]] = field(default_factory=dict)
    landed: set[str] = field(default_factory=set)
    moment: tuple[int, str] | None = None
    withdrawals: int | None = None
    """What the unit of them had as number at that moment: what has landed may be gone since."""

    @classmethod
    def of(cls, warehouse: Warehouse, mapping: Mapping) -> "KnownFiles":
        """Return what is remembered for a data root and a mapping."""
        about = sha256(f"{warehouse.root.uri}\n{mapping.canonical_json()}".encode()).hexdigest()
        cache = cache_folder("ingested") / f"{about[:32]}.json"
        with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            kept: dict[str, Any] = json.loads(cache.read_bytes())
            if "files" not in kept:  # of an earlier version, which remembered no moment
                kept = {"files": kept, "landed": [], "moment": (0, "")}
            files = {path: (int(s), t, str(d)) for path, (s, t, d) in kept["files"].items()}
            version, commit = kept["moment"]
            moment = int(version), str(commit)
            return cls(cache, files, set(kept["landed"]), moment, kept.get("withdrawals"))
        return cls(cache)

    def without_landed(self, files: Iterable[Log], warehouse: Warehouse) -> list[Log]:
        """Return the files that are not in the logs, as far as size and time of change tell."""
        snapshot = warehouse.logs.snapshot()
        if self.moment is None or snapshot.moment(self.moment[0]) != self.moment[1]:
            self.landed.clear()  # another table, or one that was restored
        self._forget_withdrawn(snapshot)
        landed = snapshot.landed_among(len(self.digests))
        return [file for file in files if not self._has_landed(file, landed)]

    def _forget_withdrawn(self, snapshot: Snapshot) -> None:
        if self.moment and snapshot.version == self.moment[0]:
            return
        if (withdrawals := snapshot.landed(WITHDRAWALS)) != self.withdrawals:
            self.landed.clear()
        self.withdrawals = withdrawals

    def _has_landed(self, file: Log, landed: Callable[[str], bool]) -> bool:
        known = self.digests.get(_name_of(file))
        if known is None or _state_of(file) != known[:2]:
            return False
        return known[2] in self.landed or landed(unit_of(known[2]).name)

    def digest_of(self, file: Log) -> str | None:
        """Return the digest of what a path had when it landed, None if it never did."""
        known = self.digests.get(_name_of(file))
        return None if known is None else known[2]

    def remember(self, file: Log, digest: str) -> None:
        """Keep in mind that a file has landed."""
        if state := _state_of(file):
            self.digests[_name_of(file)] = (*state, digest)

    def save(self, warehouse: Warehouse) -> None:
        """Write the cache; what cannot be written is not kept."""
        snapshot = warehouse.logs.snapshot()
        self._forget_withdrawn(snapshot)
        asked = {digest for _, _, digest in self.digests.values()}
        has_landed = snapshot.landed_among(len(asked))
        self.landed = {d for d in asked if d in self.landed or has_landed(unit_of(d).name)}
        version = snapshot.version or 0
        kept = {
            "files": self.digests,
            "landed": sorted(self.landed),
            "moment": [version, snapshot.moment(version)],
            "withdrawals": self.withdrawals,
        }
        with suppress(OSError):
            self.cache.parent.mkdir(parents=True, exist_ok=True)
            draft = self.cache.with_suffix(f".{os.getpid()}")
            draft.write_text(json.dumps(kept))
            draft.replace(self.cache)


def _name_of(log: Log) -> str:
    return os.path.abspath(log) if isinstance(log, Path) else str(log)  # noqa: PTH100 - the faster


def _state_of(log: Log) -> tuple[int, int | str] | None:
    """Return what changes when the content does; None if that is not known."""
    if isinstance(log, StoredFile):
        return log.size_bytes, log.identity
    if isinstance(log, StoredParts):
        return None
    try:
        found = log.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns
