"""Which drives of whole Gram files a version was trained on: the names of files instead of hashes.

    models/<name>/versions/drives-CHECKSUM.tree    Gram files, and places among the drives of each
    models/<name>/versions/drives-of-FILE.bin      a SHA-256, then the drives of a file that is gone

The name of a Gram file has the checksum of its content, and before its rows stand the hashes of its
drives (`fleet_slip.grams.rows.rollup`). So of a year a version keeps 40 kB, and writes and reads
nothing of the drives. Who deletes such a file keeps their hashes first, salted.
"""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import IntArray
from fleet_slip.canonical import canonical_json
from fleet_slip.delta.encoding import read_leading_part
from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder
from fleet_slip.grams.rows.rollup import DRIVES, Hashes, Places
from fleet_slip.models.salted_drives import salt_drives

_RESTORE = "Restore the file from a backup."
_TREE = ".tree"


def pack_files(files: Mapping[str, Places]) -> bytes:
    """Return the content of the file about Gram files and the places of drives in them."""
    return canonical_json({"files": files}).encode()


def tree_name(checksum: str) -> str:
    """Return the name of the file about the Gram files of a version."""
    return f"drives-{checksum}{_TREE}"


def read_files(versions: Folder, name: str) -> dict[str, Places]:
    """Return Gram files and the places of drives in them. Raises `StorageError` if damaged."""
    content = versions.read(name)
    if tree_name(sha256(content).hexdigest()) != name:
        raise StorageError(
            f"{versions}/{name}: its bytes do not match the checksum in its name. {_RESTORE}"
        )
    return dict(json.loads(content)["files"])


@dataclass(frozen=True)
class GramDrives:
    """Reads the drives of Gram files, in the folder `grams` or kept beside a model's versions."""

    name: str
    versions: Folder
    grams: Folder

    def read(self, path: str) -> tuple[Hashes, bool]:
        """Return hashes of a file's drives, and whether they are salted. Raises `StorageError`."""
        try:
            return self._present(path), False
        except StorageError as error:
            if _name_of(path) not in self.versions.names():
                raise StorageError(
                    f"{error} It tells which drives made versions of {self.name}."
                ) from None
        content = self.versions.read(_name_of(path))
        if sha256(content[32:]).digest() != content[:32]:
            raise StorageError(f"{self.versions}/{_name_of(path)}: is damaged. {_RESTORE}")
        return np.frombuffer(content[32:], dtype=">u8").astype(np.uint64), True

    def salted(self, path: str, places: Places) -> Hashes:
        """Return the salted hashes of a file's drives at some places."""
        hashes, salted = self.read(path)
        some = np.concatenate([hashes[first : first + many] for first, many in places])
        return some if salted else salt_drives(self.name, some)

    def find(self, path: str, drives: Hashes) -> tuple[IntArray, IntArray]:
        """Return where among a file's drives some of other drives stand, and which these are."""
        return _find(self, path, drives.tobytes())

    def keep(self, paths: Collection[str]) -> None:
        """Keep the drives of files that somebody may delete. Raises `StorageError` for one gone."""
        there = set(self.versions.names())
        for path in paths:
            if _name_of(path) not in there:
                salted = salt_drives(self.name, self._present(path)).astype(">u8").tobytes()
                self.versions.create(_name_of(path), sha256(salted).digest() + salted)

    def _present(self, path: str) -> Hashes:
        content = read_leading_part(self.grams, path, DRIVES)
        if content is None:
            raise StorageError(f"{self.grams}/{path}: lacks the hashes of its drives. {_RESTORE}")
        return np.frombuffer(content, dtype="<u8").astype(np.uint64)


@lru_cache(maxsize=2**14)
def _find(drives_of: GramDrives, path: str, drives: bytes) -> tuple[IntArray, IntArray]:
    # Remembered, since a file is named by one version after another, and never changes.
    wanted = np.frombuffer(drives, dtype=np.uint64)
    hashes, salted = drives_of.read(path)
    known = pa.array(salt_drives(drives_of.name, wanted) if salted else wanted)
    which = pc.index_in(pa.array(hashes), value_set=known)
    at = np.flatnonzero(which.is_valid().to_numpy(zero_copy_only=False))
    return at, which.drop_null().to_numpy()


def stand_at(at: IntArray, places: Places) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return which numbers are among some places."""
    firsts, many = np.array(places, dtype=np.int64).reshape(-1, 2).T
    before = np.searchsorted(firsts, at, side="right") - 1
    return (before >= 0) & (at < (firsts + many)[before])


def keep_drives_of(root: Folder, paths: Collection[str]) -> None:
    """Keep the drives of Gram files that versions name, before somebody deletes the files.

    The files are in no current version of the table. Whoever publishes a version that names one
    keeps its drives too: so none is lost between the two.
    """
    models = root / "models"
    for name in models.names() if paths else ():
        versions = models / name / "versions"
        named: set[str] = set()
        for tree in (one for one in versions.names() if one.endswith(_TREE)):
            try:
                named.update(read_files(versions, tree))
            except StorageError:  # of a version that cannot be told: it counts as trained on all
                continue
        drives_of = GramDrives(name, versions, root / "grams")
        for path in named.intersection(paths):
            try:
                drives_of.keep([path])
            except StorageError:  # damaged: nothing tells its drives
                continue


def _name_of(path: str) -> str:
    return f"drives-of-{path.removesuffix('.parquet').replace('/', '-')}.bin"
