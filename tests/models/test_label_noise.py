"""How much of a cross-validated error is noise of the label, and where nobody knows."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from fleet_slip import open as open_fleet
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.models import select as uncertainty
from fleet_slip.models.publish import manifest_of
from fleet_slip.models.select import label_noise_deg
from fleet_slip.storage.local import LocalFolder
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse


def test_the_campaigns_noise_is_what_the_label_differs_from_the_truth_by(smoke_root: Path) -> None:
    warehouse = Warehouse(LocalFolder(smoke_root))
    stated = label_noise_deg(warehouse, load_cohort(warehouse))
    with connect(smoke_root) as database:
        off = database.sql(
            "SELECT degrees(sideslip_rad - atan2(vy_mps, vx_mps)) AS off FROM log "
            "WHERE source = 'simulated' AND vx_mps > 15"
        ).fetchnumpy()["off"]
    step = math.degrees(0.005 / math.sqrt(12) / 20)  # of the true vy in the log
    assert stated == pytest.approx(math.sqrt(np.var(off) - step**2), rel=0.02)


def test_a_selection_and_its_manifest_tell_it(smoke_root: Path) -> None:
    selection = open_fleet(smoke_root).cohort().select(model="ay,yaw_rate")
    noise = math.degrees(math.hypot(0.0005, 0.0001 / math.sqrt(12)))
    assert selection.as_dict()["label_noise_deg"] == pytest.approx(noise)
    figures = manifest_of(selection, "told").cross_validation
    assert figures.label_noise_deg == pytest.approx(noise)
    assert math.hypot(figures.beyond_label_noise_deg, noise) == pytest.approx(figures.rmse_deg)
    assert selection.beyond_label_noise_deg == figures.beyond_label_noise_deg


def test_nobody_knows_the_noise_of_a_campaign_that_is_not_there(
    smoke_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "data"
    shutil.copytree(smoke_root, root)
    monkeypatch.setattr(uncertainty, "find_config", lambda *_: tmp_path / "none.toml")
    warehouse = Warehouse(LocalFolder(root))
    assert label_noise_deg(warehouse, load_cohort(warehouse)) is None
