"""The hashes of the drives that a version was trained on: the same for ever."""

import numpy as np

from fleet_slip.models.manifest import TrainedDrives


def test_hashes_of_drives_are_those_of_versions_of_before() -> None:
    """Computed by the release in which they came."""
    drives = np.array([1, 2], dtype=np.uint64)
    known = [10430483359262113544, 11180994063705713938]
    made = TrainedDrives.of("year", drives)
    assert made.salted.tolist() == known
    assert made.content == b"".join(one.to_bytes(8, "big") for one in known)
    assert TrainedDrives.unpacked("year", made.content).among(drives).all()
    assert not len(TrainedDrives.of("year", drives[:0]).salted)
    assert TrainedDrives.of("other", drives).salted.tolist() != known
