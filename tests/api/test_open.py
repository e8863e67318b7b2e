"""Data roots with different folders of configs in one process."""

import shutil
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import ConfigError
from fleet_slip.resources import SHIPPED_CONFIGS

FEATURES = """\
[sets.mine]
description = "The same name in both folders"
signals = {signals}
windows = ["ay_mean_16"]
"""
MODELS = """\
description = "The same name in both folders"
features = "mine"
[[model]]
name = "only"
signals = {signals}
"""
CAMPAIGN = """\
name = "brief"
description = "One drive"
base = "smoke"
number_of_days = 1
drives_per_day = 1
"""
SIGNAL = """
[signals.boost]
scale = 0.01
unit = "1"
column = "boost_share"
min = 0
max = 100
role = "extra"
description = "A signal that the shipped catalog lacks"
"""


def write_configs(folder: Path, signals: str, columns: str) -> Path:
    for kind in ("models", "campaigns"):
        (folder / kind).mkdir(parents=True)
    (folder / "features.toml").write_text(FEATURES.format(signals=signals))
    (folder / "models" / "few.toml").write_text(MODELS.format(signals=columns))
    return folder


@pytest.fixture
def fleets(
    smoke_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Fleet, Fleet]:
    """Two data roots with the same logs, each with its own folder of configs."""
    monkeypatch.delenv("FLEET_SLIP_CONFIG", raising=False)
    x = write_configs(tmp_path / "x", '["ay", "yaw_rate"]', '["ay", "ay_mean_16"]')
    (x / "campaigns" / "brief.toml").write_text(CAMPAIGN)
    y = write_configs(tmp_path / "y", '["yaw_rate"]', '["yaw_rate"]')
    shipped = SHIPPED_CONFIGS.file("signals.toml").read_text(encoding="utf-8")
    (y / "signals.toml").write_text(shipped + SIGNAL)
    a, b = (shutil.copytree(smoke_root, tmp_path / name) for name in "ab")
    return fleet_slip.open(a, config=x), fleet_slip.open(b, config=y)


def test_a_selection_is_not_affected_by_opening_another_root(fleets: tuple[Fleet, Fleet]) -> None:
    first, second = fleets
    first.gram("mine")
    before = first.cohort().select(models="few")
    second.maintenance.migrate()
    second.gram("mine")
    other = second.cohort().select(models="few")
    after = first.cohort().select(models="few")
    assert after.as_dict() == before.as_dict()
    assert before.winner.model.signals == ("ay", "ay_mean_16")
    assert other.winner.model.signals == ("yaw_rate",)
    identities = {selection.as_dict()["feature_set"] for selection in (after, other)}
    assert len(identities) == 2, "the same name is of two definitions"
    columns = [
        {name for name, *_ in fleet.sql("DESCRIBE log").fetchall()} for fleet in (first, second)
    ]
    assert columns[1] - columns[0] == {"boost_share"}


def test_lists_and_campaigns_of_a_folder_are_found_without_an_environment_variable(
    fleets: tuple[Fleet, Fleet],
) -> None:
    first, second = fleets
    assert first.simulate("brief").drives == 1
    with pytest.raises(ConfigError, match="no file 'brief'"):
        second.simulate("brief")
    first.gram("mine")
    published = first.models.publish("few", first.cohort().select(models="few"), force=True)
    again = first.models.publish("few")
    assert (again.new, again.version) == (False, published.version)


def test_the_environment_names_a_folder_of_configs(
    fleets: tuple[Fleet, Fleet], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = fleets
    monkeypatch.setenv("FLEET_SLIP_CONFIG", str(first.warehouse.configs.folder))
    assert fleet_slip.open(first.root).warehouse.configs == first.warehouse.configs
    chosen = second.warehouse.configs.folder
    assert fleet_slip.open(first.root, chosen).warehouse.configs == second.warehouse.configs
    monkeypatch.setenv("FLEET_SLIP_CONFIG", "/nowhere")
    with pytest.raises(ConfigError, match="/nowhere: no such folder of configs"):
        fleet_slip.open(first.root)


def test_a_closed_fleet_can_be_used_again(smoke_root: Path) -> None:
    with fleet_slip.open(smoke_root) as fleet:
        before = fleet.cohort().diagnose("smoke")
    assert fleet.cohort().diagnose("smoke").as_dict() == before.as_dict()
