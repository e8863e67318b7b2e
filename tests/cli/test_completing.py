"""What Tab completes, as a shell of the system asks for it."""

import os
from pathlib import Path

import pytest

from tests.support.commands import COMMAND, run_here


def complete(root: Path, *words: str) -> list[str]:
    typed = ["fleet-slip", "--root", str(root), *words]
    asked = {
        "_FLEET_SLIP_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(typed),
        "COMP_CWORD": str(len(typed) - 1),
    }
    done = run_here([COMMAND], env={**os.environ, **asked})
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["sh"], ["show"]),
        (["show", "sm"], ["smoke"]),
        (["show", "smoke@"], ["smoke@champion", "smoke@1"]),
        (["simulate", "water"], ["waterford", "waterford_course"]),
        (["run", "--campaign", "proving_g"], ["proving_ground", "proving_ground_course"]),
        (["select", "--models", "tab"], ["table1"]),
        (["gram", "--features", "win"], ["windows", "windows_regimes"]),
        (["evaluate", "--scenario", "mass_1"], ["mass_1000", "mass_1740"]),
        (["show", "nothing@"], []),
    ],
)
def test_names_are_completed(smoke_root: Path, words: list[str], found: list[str]) -> None:
    assert complete(smoke_root, *words) == found


def test_where_there_is_no_root_there_are_no_names(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert complete(file, "show", "s") == []
