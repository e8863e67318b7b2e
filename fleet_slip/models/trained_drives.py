"""Exactly which drives a model version was trained on, for ever, without their names.

    models/<name>/versions/drives-CHECKSUM.bin     8 bytes a drive, sorted

Tables may be gone tomorrow; from hashes, salted with the model's name, whoever knows a drive's name
can tell that it was among them. A manifest names the file by its SHA-256.
"""

from dataclasses import dataclass
from hashlib import sha256

import numpy as np

from fleet_slip.arrays import BoolArray
from fleet_slip.errors import StorageError
from fleet_slip.grams.gram_rows import Hashes
from fleet_slip.models.manifest import Manifest, salt_drives
from fleet_slip.storage.folder import Folder


@dataclass(frozen=True)
class TrainedDrives:
    """The drives of a version of the model `name`: salted hashes, sorted."""

    name: str
    salted: Hashes

    def among(self, drives: Hashes) -> BoolArray:
        """Return which of some drives, by the hashes of their names, made the version."""
        wanted, place = np.unique(drives, return_inverse=True)
        found: BoolArray = np.isin(salt_drives(self.name, wanted), self.salted)[place]
        return found


def keep_drives(versions: Folder, content: bytes) -> None:
    """Write the drives of a new version, packed, durably; nothing that is there."""
    versions.create(_file_name(checksum_of_drives(content)), content)


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
