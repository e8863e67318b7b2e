"""Exactly which drives a model version was trained on, for ever, without their names.

    models/<name>/versions/drives-CHECKSUM.bin     8 bytes a drive, sorted

Tables may be gone tomorrow; from hashes, salted with the model's name, whoever knows a drive's name
can tell that it was among them. A manifest names the file by its SHA-256.
"""

from hashlib import sha256

import numpy as np

from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder
from fleet_slip.grams.rows.rollup import Hashes
from fleet_slip.models.manifest import Manifest

_SALT = b"fleet-slip trained drives\n"
_AT_ONCE = 2**20


def pack_drives(name: str, drives: Hashes) -> bytes:
    """Return the content of the file about the drives that a model was trained on."""
    return hash_drives(name, drives).astype(">u8").tobytes()


def checksum_of_drives(content: bytes) -> str:
    """Return the SHA-256 by which a manifest names the file of its drives."""
    return sha256(content).hexdigest()


def keep_drives(versions: Folder, content: bytes) -> None:
    """Write the file of drives, durably; nothing if it is there."""
    versions.create(_file_name(checksum_of_drives(content)), content)


def read_trained_drives(versions: Folder, manifest: Manifest) -> Hashes | None:
    """Return a version's salted drive hashes, sorted, or None; raises as `read_drives_file`."""
    content = read_drives_file(versions, manifest)
    return None if content is None else np.frombuffer(content, dtype=">u8").astype(np.uint64)


def read_drives_file(versions: Folder, manifest: Manifest) -> bytes | None:
    """Return the file of a version's drives, None if it has none. Raises `StorageError`."""
    expected = manifest.trained_on.drives_sha256
    if expected is None:
        return None
    content = versions.read(_file_name(expected))
    if checksum_of_drives(content) != expected:
        raise StorageError(
            f"{versions}/{_file_name(expected)}: its bytes do not match the checksum in its name. "
            "Restore the file from a backup."
        )
    return content


def hash_drives(name: str, drives: Hashes) -> Hashes:
    """Return the salted hashes of drives, as the versions of a model keep them, sorted."""
    return np.sort(salt_drives(name, drives))


def salt_drives(name: str, drives: Hashes) -> Hashes:
    """Return the salted hash of each drive, in the order of the drives."""
    salt, numbers = _SALT + name.encode(), drives.astype("<u8")
    hashed = np.empty(len(drives), dtype=np.uint64)
    for first in range(0, len(drives), _AT_ONCE):
        some = numbers[first : first + _AT_ONCE].tobytes()
        digests = [sha256(salt + some[at : at + 8]).digest()[:8] for at in range(0, len(some), 8)]
        hashed[first : first + _AT_ONCE] = np.frombuffer(b"".join(digests), dtype=">u8")
    return hashed


def _file_name(sha256: str) -> str:
    return f"drives-{sha256}.bin"
