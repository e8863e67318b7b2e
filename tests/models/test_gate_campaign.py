"""The gate on a simulated campaign of 96 drives, as it is at night."""

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from fleet_slip.errors import RefusedError
from fleet_slip.grams.job import update_grams
from fleet_slip.models.publish import Publication, manifest_of, publish
from fleet_slip.models.registry import Registry
from fleet_slip.models.request import SelectionRequest
from fleet_slip.models.select import answer_request
from fleet_slip.resources import find_config
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.simulation.job import simulate_campaign
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land
from tests.support.once import made_once

SIGNALS = "ay,yaw_rate,steering_wheel,wheel_rl"


@pytest.fixture(scope="module")
def campaign_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Short drives of the shipped campaign, all 96, reduced and published."""

    def make(root: Path) -> None:
        text = find_config("campaigns", "waterford").read_text()
        assert "laps = 2\n" in text
        file = root.with_name("short.toml")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text.replace("laps = 2\n", "laps = 0.1\n"))
        campaign, warehouse = load_campaign(str(file)), Warehouse(LocalFolder(root))
        with ThreadPoolExecutor(2) as threads:
            simulate_campaign(warehouse, campaign, campaign.days(), threads)
        update_grams(warehouse)
        assert publish_from(warehouse).version.manifest.trained_on.drives == 96

    return made_once(tmp_path_factory, "gate_campaign", make)


@pytest.fixture
def champion(campaign_root: Path, tmp_path: Path) -> Warehouse:
    """A copy of it."""
    return Warehouse(LocalFolder(Path(shutil.copytree(campaign_root, tmp_path / "data"))))


def publish_from(warehouse: Warehouse, cohort: str = "true") -> Publication:
    answer = answer_request(warehouse, SelectionRequest(nested=SIGNALS), cohort)
    registry = Registry(warehouse.root / "models")
    return publish(registry, manifest_of(answer, "beta"), answer)


def land_again(warehouse: Warehouse, change: Callable[[pa.ChunkedArray], pa.Array]) -> None:
    """Land every drive once more, under another name and with another label."""
    for number, file in enumerate(warehouse.logs.snapshot().files):
        assert file.day is not None
        rows = warehouse.logs.read(file.path)
        names = pc.binary_join_element_wise("again", rows["drive_id"].cast(pa.string()), "-")
        for column, values in (("drive_id", names), ("sideslip", change(rows["sideslip"]))):
            place = rows.schema.get_field_index(column)
            kept = rows.schema.field(column)
            rows = rows.set_column(place, kept, values.cast(kept.type))
        land(warehouse, f"again-{number}", rows, day=file.day)
    update_grams(warehouse)


def test_96_drives_again_with_the_label_negated_make_no_champion(champion: Warehouse) -> None:
    land_again(champion, pc.negate)
    with pytest.raises(RefusedError, match=r"its correlation is"):
        publish_from(champion)
    with pytest.raises(
        RefusedError, match=r"opposite sign of the estimates of beta@1\. Is it reversed"
    ):
        publish_from(champion, "drive_id LIKE 'again-%'")
    assert Registry(champion.root / "models").versions("beta") == [1]


def test_16_drives_do_not_replace_a_champion_of_96(champion: Warehouse) -> None:
    names = sorted(
        name
        for file in champion.logs.snapshot().files
        for name in champion.logs.read(file.path, ["drive_id"])["drive_id"].unique().to_pylist()
    )
    assert len(names) == 96
    few = ", ".join(f"'{name}'" for name in names[:: 96 // 16])
    with pytest.raises(RefusedError, match="on 16 drives, less than 50% of the champion's 96"):
        publish_from(champion, f"drive_id IN ({few})")
    assert Registry(champion.root / "models").versions("beta") == [1]
