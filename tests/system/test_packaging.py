"""The wheel works without the checkout: its SQL and configs are inside."""

import shutil
import sys
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
    shutil.unpack_archive(wheel, folder / "site", format="zip")
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


@pytest.mark.long
@pytest.mark.tools("twine", "check-wheel-contents")
def test_a_published_wheel_installs_in_an_empty_environment_and_runs_the_demo(
    tmp_path: Path,
) -> None:
    """The wheel is built from the source distribution, as installers and `uvx` build it."""
    build = [sys.executable, "-m", "hatchling", "build", "--directory", str(tmp_path)]
    assert run([*build, "--target", "sdist"], cwd=CHECKOUT).exit_code == 0
    (sdist,) = tmp_path.glob("*.tar.gz")
    shutil.unpack_archive(sdist, tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    built = run([*build, "--target", "wheel"], cwd=source)
    assert built.exit_code == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    for check in (["twine", "check", "--strict", str(sdist)], ["check-wheel-contents"]):
        checked = run([*check, str(wheel)])
        assert checked.exit_code == 0, checked.stdout + checked.stderr

    environment = tmp_path / "environment"
    assert run([sys.executable, "-m", "venv", str(environment)]).exit_code == 0
    program = environment / "bin/fleet-slip"
    pip = [str(environment / "bin/python"), "-m", "pip", "--disable-pip-version-check", "install"]
    constraints = ["--quiet", "--constraint", str(CHECKOUT / "constraints.txt")]
    installed = run([*pip, *constraints, str(wheel)])
    assert installed.exit_code == 0, installed.stderr
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    isolated = {"PATH": "/usr/bin:/bin", "HOME": str(folder)}
    demo = run([str(program), "demo"], cwd=folder, env=isolated)
    assert demo.exit_code == 0, demo.stderr
    assert "12 simulated drives" in demo.stdout
    for file in ("report.html", "c/sideslip_demo.c"):
        assert (folder / "fleet-slip-demo" / file).stat().st_size > 10_000
    (folder / "log.mf4").write_bytes(b"MDF     4.10    " + bytes(1000))
    missing = run([str(program), "mapping", "suggest", "log.mf4"], cwd=folder, env=isolated)
    assert missing.exit_code == 13
    assert 'pip install "fleet-slip[logs]", or start by: uvx "fleet-slip[logs]"' in missing.stderr
