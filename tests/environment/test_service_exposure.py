"""The shipped systemd service, examined by systemd's own tools."""

import shutil
from datetime import date
from pathlib import Path

import pytest

from tests.support.commands import COMMAND, run
from tests.support.landing import Landing

SCHEDULE = Path(__file__).parents[2] / "jobs/schedule"
EXPOSURE_TENTHS = 10
"""1.0 of 10: systemd calls that safe. Without the settings it is 8.7."""

pytestmark = pytest.mark.tools("systemd-analyze")


def security(unit: Path) -> int:
    command = ["systemd-analyze", "security", "--offline=yes", f"--threshold={EXPOSURE_TENTHS}"]
    return run([*command, "--no-pager", str(unit)]).exit_code


def test_the_service_is_exposed_to_little(tmp_path: Path) -> None:
    unit = SCHEDULE / "fleet-slip.service"
    assert security(unit) == 0
    bare = tmp_path / "fleet-slip.service"
    lines = [line for line in unit.read_text().splitlines() if not line.startswith("Cap")]
    bare.write_text("\n".join(lines))
    assert security(bare) != 0


def test_systemd_understands_the_units(tmp_path: Path) -> None:
    for unit in ("fleet-slip.service", "fleet-slip.timer"):
        text = (SCHEDULE / unit).read_text()
        (tmp_path / unit).write_text(text.replace("/opt/fleet-slip/.venv/bin/fleet-slip", COMMAND))
    units = [str(tmp_path / unit) for unit in ("fleet-slip.service", "fleet-slip.timer")]
    checked = run(["systemd-analyze", "verify", "--man=no", *units])
    assert (checked.exit_code, checked.stderr) == (0, "")


def allowed_calls() -> set[str]:
    """Return the system calls that the service may make."""

    def group(name: str) -> set[str]:
        lines = run(["systemd-analyze", "syscall-filter", "--no-pager", name]).stdout.splitlines()
        calls: set[str] = set()
        for line in map(str.strip, lines[1:]):
            if line.startswith("@"):
                calls |= group(line)
            elif line and not line.startswith("#"):
                calls.add(line)
        return calls

    return group("@system-service") - group("@privileged")


@pytest.mark.tools("strace")
@pytest.mark.skipif(not shutil.which("strace"), reason="strace is not here")
def test_a_night_makes_no_other_system_calls(tmp_path: Path, smoke_root: Path) -> None:
    landing = Landing(tmp_path / "landing", smoke_root)
    landing.prepare()
    landing.land("first", landing.drives(), date(2026, 10, 5))
    words = [COMMAND, "--root", str(tmp_path / "data"), "nightly", "--inbox", landing.folder]
    options = ["--mapping", landing.mapping, "--model", "fleet", "--models", "table1"]
    counts = tmp_path / "calls"
    command = ["strace", "-f", "-c", "-S", "name", "-U", "name", "-o", str(counts)]
    done = run([*command, *map(str, words), *map(str, options)])
    if "ptrace" in done.stderr and done.exit_code:
        pytest.skip("this machine does not let one process trace another")
    assert done.exit_code == 0, done.stderr
    calls = {line.strip() for line in counts.read_text().splitlines()[2:]}
    calls -= {"total", ""} | {line for line in calls if set(line) <= {"-", " "}}
    assert len(calls) > 20
    assert calls - allowed_calls() <= {"chown", "fchown", "lchown", "setns"} - {"setns"}
