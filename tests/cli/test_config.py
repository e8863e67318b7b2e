"""A folder of configs of one's own, laid over the shipped ones, through the command line."""

import os
from pathlib import Path

import pytest

from tests.support.commands import RunCommand

OWN = """
[windows.steer_fl_mean]
of = "steer_fl"
over = "mean"
ticks = [10, 50]
scale = 0.00001
unit = "rad"
column = "steer_fl_mean_{ticks}_rad"
description = "Mean steering angle"

[sets.mine]
description = "Steering over time"
signals = ["ay", "yaw_rate"]
windows = ["steer_fl_mean", "ay_mean_16"]
"""


@pytest.fixture
def config_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "own"
    (folder / "models").mkdir(parents=True)
    (folder / "features.toml").write_text(OWN, encoding="utf-8")
    (folder / "models" / "few.toml").write_text(
        'description = "Mine"\nfeatures = "mine"\n[[model]]\nname = "1"\n'
        'signals = ["ay", "steer_fl_mean_50"]\n',
        encoding="utf-8",
    )
    return folder


def test_own_features_and_lists_are_used_without_touching_the_package(
    run_command: RunCommand, config_folder: Path, smoke_copy: Path
) -> None:
    own_first = ("--config", str(config_folder))
    missing = run_command(*own_first, "select", "--models", "few")
    assert missing.exit_code == 5
    assert "fleet-slip gram --features mine" in missing.stderr
    done = run_command(*own_first, "gram", "--features", "mine")
    assert done.exit_code == 0, done.stderr
    selection = run_command(*own_first, "select", "--models", "few", "--json").json
    assert selection["models"][0]["signals"] == ["ay", "steer_fl_mean_50"]
    assert run_command("select", "--models", "few").exit_code == 3
    published = run_command(*own_first, "publish", "mine", "--models", "few")
    assert published.exit_code == 0, published.stderr
    # The manifest defines its columns itself: the folder is no longer needed.
    scored = run_command("score", "mine", "--json").json
    assert scored["rows"] == selection["rows"]
    assert abs(scored["rmse_deg"] / selection["models"][0]["rmse_deg"] - 1) < 0.2
    by_environment = run_command(
        "features", "--files", "--json", env={**os.environ, "FLEET_SLIP_CONFIG": str(config_folder)}
    )
    assert by_environment.exit_code == 0
    files = {name: entry["from"] for name, entry in by_environment.json.items()}
    assert files["features.toml"] == files["models/few.toml"] == "own"
    assert files["signals.toml"] == "shipped"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("feature.toml", "", "no config of fleet-slip"),
        ("model/x.toml", "", "no config of fleet-slip"),
        ("features.toml", "[widnows.x]\nof = 'ay'", "widnows: unknown key"),
        ("features.toml", OWN.replace('steer_fl"', 'sideslip"', 1), "no input signal or feature"),
        ("features.toml", OWN.replace("0.00001", "0.0000000001"), "choose scales whose ratio"),
        ("features.toml", OWN.replace("[10, 50]", "[10, 0]"), "ticks must lie in"),
        ("features.toml", OWN.replace('"ay_mean_16"', '"ay_mean_17"'), "unknown ay_mean_17"),
    ],
)
def test_an_invalid_config_is_reported_and_changes_nothing(
    run_command: RunCommand, tmp_path: Path, name: str, text: str, message: str
) -> None:
    file = tmp_path / "own" / name
    file.parent.mkdir(parents=True)
    file.write_text(text, encoding="utf-8")
    done = run_command("--config", str(tmp_path / "own"), "features", "--files")
    assert done.exit_code == 3
    assert message in done.stderr


def test_the_query_of_a_column_runs_as_it_is_printed(
    run_command: RunCommand, smoke_root: Path
) -> None:
    for name in ("ay_bias", "ay_mean_16_mass", "ay_excess"):
        query = run_command("features", "--sql", name).stdout
        command = ("sql", f"SELECT count({name}) AS n FROM ({query})", "--json")
        rows = run_command(*command, root=smoke_root).json
        assert rows[0]["n"] > 1000, name
    assert run_command("features", "--sql", "mood").exit_code == 5
