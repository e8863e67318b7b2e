"""The shipped systemd service's conditions, without systemd.

Another user without a home, the whole file system read-only but for the data root and the cache
folder, and no more environment than systemd gives: by mounts in a namespace of their own.
"""

import configparser
import json
import os
import shlex
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from datetime import date
from pathlib import Path

import pytest

from tests.support import commands
from tests.support.commands import COMMAND, Finished
from tests.support.landing import Landing

UNIT = Path(__file__).parents[2] / "jobs/schedule/fleet-slip.service"
NOBODY = 65534
DIRECTORIES = {
    "StateDirectory": ("/var/lib", "state", "STATE_DIRECTORY"),
    "CacheDirectory": ("/var/cache", "cache", "CACHE_DIRECTORY"),
    "LogsDirectory": ("/var/log", "logs", "LOGS_DIRECTORY"),
}
"""Parents of the folders that systemd creates for the service, and their variables."""


def can_confine() -> bool:
    if os.geteuid() != 0 or not shutil.which("unshare") or not shutil.which("setpriv"):
        return False
    remount = commands.run(["unshare", "--mount", "mount", "-o", "remount,bind,ro", "/"])
    return remount.exit_code == 0


pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        not can_confine(), reason="a service is confined by root, with unshare and setpriv"
    ),
]


@pytest.fixture
def service() -> dict[str, str]:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(UNIT)
    return dict(parser["Service"])


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that another user can reach; pytest's own is closed to others."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


def confined(service: dict[str, str], folder: Path, arguments: list[str], **extra: str) -> str:
    """Return a script that does in a mount namespace what systemd does for the service."""
    assert service["ProtectSystem"] == "strict"
    lines = ["set -e"]
    environment = dict([service["Environment"].split("=", 1)]) | extra
    places: dict[Path, Path] = {}
    for setting, (parent, subfolder, variable) in DIRECTORIES.items():
        if setting in service:
            place = Path(parent) / service[setting]
            places[place] = folder / subfolder
            environment[variable] = str(place)
    for place, real in places.items():
        real.mkdir(exist_ok=True)
        os.chown(real, NOBODY, NOBODY)
        lines += [
            f"mount -t tmpfs none {place.parent}",
            f"mkdir {place}",
            f"mount --bind {real} {place}",
        ]
    needed = [Path(sys.executable).resolve(), Path(COMMAND).resolve()]
    lines += show_closed_folders(needed, folder / "shown")
    lines.append("mount -o remount,bind,ro /")
    variables = " ".join(f"{k}={shlex.quote(v)}" for k, v in environment.items())
    lines.append(
        f"cd / && exec setpriv --reuid={NOBODY} --regid={NOBODY} --clear-groups --no-new-privs "
        f"env -i PATH=/usr/bin:/bin {variables} {COMMAND} {shlex.join(arguments)}"
    )
    return "\n".join(lines)


def show_closed_folders(files: list[Path], aside: Path) -> Iterator[str]:
    """Yield how to show others what files need of folders that are closed to them.

    A clone often lies in a folder of one user alone: a home, or one made by ``mktemp -d``.
    """
    closed: dict[Path, set[Path]] = {}
    for file in files:
        for parent, child in zip(file.parents[1:], file.parents, strict=False):
            if not parent.stat().st_mode & stat.S_IXOTH:
                closed.setdefault(parent, set()).add(child)
    for parent in sorted(closed, key=lambda path: len(path.parts), reverse=True):
        shown = {child: aside / child.relative_to("/") for child in sorted(closed[parent])}
        for child, place in shown.items():
            yield f"mkdir -p {place} && mount --rbind {child} {place}"
        yield f"mount -t tmpfs -o mode=755 none {parent}"
        for child, place in shown.items():
            yield f"mkdir -p {child} && mount --move {place} {child}"


def run(script: str) -> Finished:
    return commands.run(["unshare", "--mount", "--propagation", "private", "bash", "-c", script])


def test_the_service_does_its_night(
    service: dict[str, str], folder: Path, smoke_root: Path
) -> None:
    landing = Landing(folder / "landing", smoke_root)
    landing.prepare()
    landing.land("first", landing.drives(), date(2026, 10, 5))
    words = shlex.split(service["ExecStart"])[1:]
    words[words.index("--inbox") + 1] = str(landing.folder)
    words[words.index("--mapping") + 1] = str(landing.mapping)
    done = run(confined(service, folder, [*words, "--json"]))
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout)["champion"] == "fleet@1"
    assert "compiled" not in done.stderr
    assert (folder / "state/models/fleet/versions/1.json").stat().st_uid == NOBODY
    assert {file.suffix for file in (folder / "logs").iterdir()} == {".txt", ".json"}
