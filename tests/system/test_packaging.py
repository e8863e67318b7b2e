"""The wheel works without the checkout: its SQL and configs are inside."""

import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.commands import Finished, run

CHECKOUT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the wheel installs."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    built = run([*build, "--wheel-dir", str(folder), str(CHECKOUT)])
    assert built.exit_code == 0, built.stderr
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def run_wheel(site: Path, folder: Path, *arguments: str) -> Finished:
    """Run the program of the wheel on `data` in a folder."""
    code = "import sys; from fleet_slip.cli.main import main; sys.argv[0] = 'fleet-slip'; main()"
    path = {"PYTHONPATH": str(site), "PATH": "/usr/bin:/bin", "HOME": str(folder)}
    command = [sys.executable, "-P", "-c", code, "--root", "data", *arguments]
    done = run(command, cwd=folder, env=path)
    assert done.exit_code == 0, done.stderr
    return done


def test_the_wheel_has_the_package_and_its_data_and_nothing_else(site: Path) -> None:
    package = files_in(site / "fleet_slip")
    source = files_in(CHECKOUT / "fleet_slip")
    assert {name: text for name, text in package.items() if name.parts[0] != "_data"} == source
    assert not [path.name for path in site.glob("*") if not path.name.startswith("fleet_slip")]
    for folder in ("configs", "jobs", "warehouse"):
        assert files_in(site / "fleet_slip/_data" / folder) == files_in(CHECKOUT / folder)


def files_in(folder: Path) -> dict[Path, bytes]:
    return {
        file.relative_to(folder): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }


@pytest.mark.long
def test_the_wheel_runs_the_job_away_from_the_checkout(site: Path, tmp_path: Path) -> None:
    """All that is compiled is compiled anew."""
    assert "published smoke@1" in run_wheel(site, tmp_path, "run", "--campaign", "smoke").stderr
