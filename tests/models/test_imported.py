"""A version that release 0.2.0 imported from another data root is not taken for one of here."""

from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.errors import DataError
from fleet_slip.models.manifest import ImportedFrom
from fleet_slip.models.publish import is_up_to_date
from fleet_slip.operations.monitor import monitor
from fleet_slip.operations.verify import Verification, verify_models


def test_the_tables_here_are_not_those_that_made_it(smoke_root: Path, tmp_path: Path) -> None:
    """Their numbers would be taken for those of tables here, by chance the same."""
    home, away = fleet_slip.open(smoke_root), fleet_slip.open(tmp_path / "away")
    made = home.model("smoke")
    origin = ImportedFrom(reference=made.reference, sha256=made.sha256)
    drives = home.registry().trained_drives(made.manifest)
    assert drives is not None
    manifest = made.manifest.model_copy(update={"imported_from": origin})
    brought = away.registry().add(manifest, drives.content)
    arguments = (home.warehouse, made.manifest.trained_on.cohort, "estimator", None)
    assert is_up_to_date(made.manifest, *arguments)
    assert not is_up_to_date(brought.manifest, *arguments)
    with pytest.raises(DataError, match="monitor smoke --since DAY"):
        monitor(home.warehouse, brought)
    report = Verification()
    verify_models(away.warehouse, {}, report)
    assert report.findings == []
