"""The wheel works without the checkout: its SQL and configs are inside."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_wheel_runs_the_job_away_from_the_checkout(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(tmp_path), str(CHECKOUT)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "site")
    assert "fleet_slip/py.typed" in names
    assert not [name for name in names if name.startswith(("tests", "benchmarks", "configs"))]
    code = "import sys; from fleet_slip.cli.main import main; sys.argv[0] = 'fleet-slip'; main()"
    command = [sys.executable, "-P", "-c", code, "--root", "data", "run", "--campaign", "smoke"]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "site"), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "published smoke@1" in done.stderr
    where = subprocess.run(
        [sys.executable, "-P", "-c", "import fleet_slip; print(fleet_slip.__file__)"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert str(tmp_path) in where.stdout
