"""The core alone: what it does without the packages of the extras, and what it says of the rest."""

import json
import re
import shutil
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.support.commands import run

REPOSITORY = Path(__file__).parents[2]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
MODULES = {
    "mcap-ros2-support": "mcap_ros2",
    "openlineage-python": "openlineage",
    "mlflow-skinny": "mlflow",
    "python-can": "can",
    "scikit-learn": "sklearn",
}
PROGRAM = """
import json, sys
absent = set(json.loads(sys.argv[1]))
class Finder:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, *where):
        return None if name.partition(".")[0] in absent else self.finder.find_spec(name, *where)
sys.meta_path = [Finder(one) for one in sys.meta_path]
from fleet_slip.cli.main import main
codes = []
for words in json.loads(sys.argv[2]):
    sys.argv = ["fleet-slip", *words]
    try:
        main()
    except SystemExit as ended:
        codes.append(ended.code)
sys.exit(str(codes))
"""


def of_extras(*extras: str) -> list[str]:
    """The modules that the packages of all extras, or of some, are imported as."""
    stated = [t for name in extras or EXTRAS for t in EXTRAS[name]]
    names = {Requirement(text).name for text in stated}
    return sorted({MODULES.get(name, name) for name in names})


def run_without(absent: list[str], *commands: list[str]) -> tuple[list[int], str]:
    """Give commands in a process in which some modules are missing.

    Returns their exit codes, and what they said.
    """
    words = [sys.executable, "-c", PROGRAM, json.dumps(absent), json.dumps(commands)]
    *messages, codes = run(words).stderr.splitlines()
    return json.loads(codes), "\n".join(messages)


@pytest.fixture
def root(smoke_root: Path, tmp_path: Path) -> Path:
    """A data root of each test's own, without the failures of other tests, which `status` tells."""
    without = shutil.ignore_patterns("runs")
    return Path(shutil.copytree(smoke_root, tmp_path / "data", ignore=without))


def test_querying_and_selecting_need_the_core_alone(root: Path, tmp_path: Path) -> None:
    list_path = str(tmp_path / "own.toml")
    at = ["--root", str(root)]
    commands = [
        [*at, "sql", "SELECT count(*) FROM log"],
        [*at, "gram"],
        [*at, "select", "--models", "table1"],
        [*at, "select", "--order", "ay,yaw_rate,ax", "--save", list_path],
        [*at, "publish", "core", "--models", list_path],
        [*at, "show", "core"],
        [*at, "score", "core"],
        [*at, "quality"],
        [*at, "verify"],
        [*at, "status"],
    ]
    codes, messages = run_without(of_extras(), *commands)
    assert codes == [0] * len(commands), messages


def test_a_missing_extra_is_named() -> None:
    codes, messages = run_without(of_extras("objects"), ["--root", "s3://bucket/data", "status"])
    assert codes == [13], messages
    assert (
        'which is not installed. Run: pip install "fleet-slip[objects]", or start by: uvx'
        in messages
    )


def test_every_extra_that_is_named_is_one() -> None:
    sources = "".join(path.read_text() for path in (REPOSITORY / "fleet_slip").rglob("*.py"))
    named = set(re.findall(r'require_extra\(\s*"(\w+)"', sources))
    assert named
    assert named <= EXTRAS.keys()
