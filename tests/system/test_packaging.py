"""The wheel works without the checkout: its SQL and configs are inside."""

import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.commands import run

CHECKOUT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_wheel_runs_the_job_away_from_the_checkout(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    built = run([*build, "--wheel-dir", str(tmp_path), str(CHECKOUT)])
    assert built.exit_code == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "site")
    assert "fleet_slip/py.typed" in names
    assert not [name for name in names if name.startswith(("tests", "benchmarks", "configs"))]
    code = "import sys; from fleet_slip.cli.main import main; sys.argv[0] = 'fleet-slip'; main()"
    command = [sys.executable, "-P", "-c", code, "--root", "data", "run", "--campaign", "smoke"]
    path = {"PYTHONPATH": str(tmp_path / "site"), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    done = run(command, cwd=tmp_path, env=path)
    assert done.exit_code == 0, done.stderr
    assert "published smoke@1" in done.stderr
    telling = [sys.executable, "-P", "-c", "import fleet_slip; print(fleet_slip.__file__)"]
    where = run(telling, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path / "site")})
    assert str(tmp_path) in where.stdout
