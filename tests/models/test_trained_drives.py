"""The hashes of the drives that a version was trained on: the same for ever."""

import numpy as np

from fleet_slip.models.manifest import hash_drives
from fleet_slip.models.trained_drives import pack_hashes


def test_hashes_of_drives_are_those_of_versions_of_before() -> None:
    """Computed by the release in which they came."""
    drives = np.array([1, 2], dtype=np.uint64)
    known = [10430483359262113544, 11180994063705713938]
    assert hash_drives("year", drives).tolist() == known
    assert pack_hashes(hash_drives("year", drives)) == b"".join(
        one.to_bytes(8, "big") for one in known
    )
    assert not len(hash_drives("year", drives[:0]))
    assert hash_drives("other", drives).tolist() != known
