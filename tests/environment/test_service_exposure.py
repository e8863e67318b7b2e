"""The shipped systemd service, examined by systemd's own tools."""

from pathlib import Path

import pytest

from tests.support.commands import COMMAND, run

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
    kept = [line for line in unit.read_text().splitlines() if not line.startswith("Cap")]
    bare.write_text("\n".join(kept))
    assert security(bare) != 0


def test_systemd_understands_the_units(tmp_path: Path) -> None:
    for unit in ("fleet-slip.service", "fleet-slip.timer"):
        text = (SCHEDULE / unit).read_text()
        (tmp_path / unit).write_text(text.replace("/opt/fleet-slip/.venv/bin/fleet-slip", COMMAND))
    units = [str(tmp_path / unit) for unit in ("fleet-slip.service", "fleet-slip.timer")]
    checked = run(["systemd-analyze", "verify", "--man=no", *units])
    assert (checked.exit_code, checked.stderr) == (0, "")
