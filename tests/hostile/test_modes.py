"""Files of a data root follow the umask, temporary ones too."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest

from fleet_slip.base import no_progress
from fleet_slip.grams.job import update_grams
from fleet_slip.models.registry import Registry
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, path_of, random_counts
from tests.support.manifests import manifest, publish


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_nobody_gets_more_rights_than_the_umask_gives(tmp_path: Path, umask: int) -> None:
    old = os.umask(umask)
    try:
        warehouse = Warehouse(LocalFolder(tmp_path / "data"))
        land(warehouse, "one", log_rows("d", random_counts(np.random.default_rng(1), 20)))
        update_grams(warehouse, no_progress)
        publish(Registry(warehouse.root / "models"), manifest())
    finally:
        os.umask(old)
    files = [*path_of(warehouse.root).rglob("*")]
    assert len(files) > 10
    for file in files:
        assert not stat.S_IMODE(file.stat().st_mode) & umask, file
