"""Hashes of drives as they stay where rows go: salted with a model's name."""

from hashlib import sha256

import numpy as np

from fleet_slip.grams.rows.gram_rows import Hashes

_SALT = b"fleet-slip trained drives\n"
_AT_ONCE = 2**20


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
