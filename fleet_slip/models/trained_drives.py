"""Exactly which drives a model version was trained on, for ever, without their names.

    models/<name>/versions/drives-CHECKSUM.bin     8 bytes a drive, sorted
    models/<name>/versions/drives-CHECKSUM.tree    Gram files (`fleet_slip.models.drives_of_files`)

Tables may be gone tomorrow; from hashes, salted with the model's name, whoever knows a drive's name
can tell that it was among them. A manifest names the files by their SHA-256: drives of Gram rows
with a rollup are in the second, others in the first.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256

import numpy as np

from fleet_slip.arrays import BoolArray
from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder
from fleet_slip.grams.rows.rollup import Hashes, Places
from fleet_slip.models.drives_of_files import GramDrives, pack_files, stand_at, tree_name
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.salted_drives import hash_drives, salt_drives


@dataclass(frozen=True)
class DriveRecord:
    """What a new version keeps of its drives: the content of the first file, and Gram files."""

    listed: bytes
    files: Mapping[str, Places] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, files: Mapping[str, Places], others: Hashes) -> "DriveRecord":
        """Return the record of drives of Gram files and of others, for a model of some name."""
        return cls(pack_hashes(hash_drives(name, others)), files)

    @property
    def listed_sha256(self) -> str:
        """The SHA-256 by which a manifest names the first file."""
        return checksum_of_drives(self.listed)

    @property
    def files_sha256(self) -> str | None:
        """The SHA-256 by which a manifest names the second file; None if there is none."""
        return checksum_of_drives(pack_files(self.files)) if self.files else None

    def keep(self, versions: Folder) -> None:
        """Write the files, durably; nothing that is there."""
        versions.create(_file_name(self.listed_sha256), self.listed)
        if self.files_sha256:
            versions.create(tree_name(self.files_sha256), pack_files(self.files))


@dataclass(frozen=True)
class TrainedDrives:
    """The drives of a version.

    Attributes:
        listed: salted hashes, sorted.
        files: Gram files, and the places of drives among theirs.
        of_files: reads those.
    """

    listed: Hashes
    files: Mapping[str, Places]
    of_files: GramDrives

    def among(self, drives: Hashes) -> BoolArray:
        """Return which of some drives, by the hashes of their names, made the version."""
        wanted, place = np.unique(drives, return_inverse=True)
        found = np.isin(salt_drives(self.of_files.name, wanted), self.listed)
        for path, places in self.files.items():
            at, which = self.of_files.find(path, wanted)
            found[which[stand_at(at, places)]] = True
        return found[place]

    def salted(self) -> Hashes:
        """Return the salted hash of each, once, sorted."""
        if not self.files:
            return self.listed
        parts = [self.of_files.salted(path, places) for path, places in self.files.items()]
        return np.unique(np.concatenate([self.listed, *parts]))


def read_listed(versions: Folder, manifest: Manifest) -> Hashes | None:
    """Return a version's listed drives, None if it has none. Raises `StorageError`."""
    expected = manifest.trained_on.drives_sha256
    if expected is None:
        return None
    content = versions.read(_file_name(expected))
    if checksum_of_drives(content) != expected:
        raise StorageError(
            f"{versions}/{_file_name(expected)}: its bytes do not match the checksum in its name. "
            "Restore the file from a backup."
        )
    return np.frombuffer(content, dtype=">u8").astype(np.uint64)


def pack_hashes(hashes: Hashes) -> bytes:
    """Return salted hashes as files hold them."""
    return hashes.astype(">u8").tobytes()


def checksum_of_drives(content: bytes) -> str:
    """Return the SHA-256 by which a manifest names a file of its drives."""
    return sha256(content).hexdigest()


def _file_name(sha256: str) -> str:
    return f"drives-{sha256}.bin"
