"""People decide what the champion is, by commands, and it lasts."""

import shutil
from pathlib import Path

from tests.support.commands import RunCommand

WORSE = ("publish", "smoke", "--features", "windows", "--nested", "ax", "--json")


def test_candidates_wait_are_compared_and_promoted(
    run_command: RunCommand, smoke_root: Path, tmp_path: Path
) -> None:
    shutil.copytree(smoke_root, tmp_path / "data")
    assert run_command(*WORSE).exit_code == 7
    waiting = run_command(*WORSE, "--candidate").json
    assert (waiting["version"], waiting["candidate"]) == (2, True)
    assert "worse than the champion" in waiting["reason"]
    assert run_command("show", "smoke", "--json").json["version"] == 1
    compared = run_command("diff", "smoke@champion", "smoke@candidate")
    assert "selected_by.asked.features" in compared.stdout and "sha256" not in compared.stdout
    assert "8 made both, 0 only smoke@1, 0 only smoke@2" in compared.stderr
    assert "are the same estimator" in run_command("diff", "smoke@1", "smoke@1").stderr
    names = ("smoke@champion", "smoke@candidate")
    better, worse = (run_command("score", name, "--json").json for name in names)
    assert (better["model"], worse["model"]) == ("smoke@1", "smoke@2")
    assert better["rows"] == worse["rows"]
    assert better["rmse_deg"] < worse["rmse_deg"]
    assert run_command("promote", "smoke@candidate").exit_code == 0
    assert run_command("show", "smoke", "--json").json["version"] == 2


def test_no_night_moves_a_champion_that_was_pinned_or_rolled_back(
    run_command: RunCommand, smoke_root: Path, tmp_path: Path
) -> None:
    shutil.copytree(smoke_root, tmp_path / "data")
    assert run_command(*WORSE, "--force").exit_code == 0
    for hold in (["pin", "smoke"], ["promote", "smoke", "--previous"]):
        assert run_command(*hold).exit_code == 0
        before = run_command("show", "smoke", "--json").json["version"]
        night = run_command("publish", "smoke", "--nested", "ay,yaw_rate", "--force", "--json")
        assert night.json["candidate"]
        assert run_command("show", "smoke", "--json").json["version"] == before
    assert run_command("pin", "smoke", "--off").exit_code == 0
    night = run_command("publish", "smoke", "--nested", "ay,yaw_rate", "--force", "--json")
    assert not night.json["candidate"]
