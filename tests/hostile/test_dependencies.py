"""What is installed is what was pinned, fits together, and may be used.

Known vulnerabilities are looked up by `pip-audit`, which needs a network; this does not.
"""

import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).parents[2]
LICENCES = re.compile(
    r"MIT|BSD|Apache|PSF|Python Software Foundation|ISC|MPL|Mozilla|Zlib|0BSD|CC0|LGPL", re.I
)


def pinned() -> dict[str, str]:
    """The version that each package is pinned to."""
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    pins = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {canonicalize_name(name): version for name, version in pins}


def required() -> dict[str, str]:
    """Every installed package that fleet-slip needs, itself aside, with its version."""
    found: dict[str, str] = {}
    waiting = [Requirement("fleet-slip[signing,rivals]")]
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue  # of an extra that is not installed here
        extras = wanted.extras or {""}
        for text in package.requires or ():
            needed = Requirement(text)
            marker = needed.marker
            applies = marker is None or any(marker.evaluate({"extra": e}) for e in extras)
            if applies and canonicalize_name(needed.name) not in found:
                waiting.append(needed)
        found[name] = package.version
    del found["fleet-slip"]
    return found


def test_what_is_installed_is_what_was_pinned() -> None:
    pins = pinned()
    assert {name: pins.get(name) for name in required()} == required()


def test_the_packages_fit_together() -> None:
    command = [sys.executable, "-m", "pip", "check", "--disable-pip-version-check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_every_licence_lets_us_use_the_package() -> None:
    unknown = []
    for name in required():
        metadata = distribution(name).metadata.json
        stated = [metadata.get("license_expression", ""), str(metadata.get("license", ""))[:200]]
        stated += [text for text in metadata.get("classifier", []) if text.startswith("License")]
        if not LICENCES.search(" ".join(map(str, stated))):
            unknown.append(name)
    assert unknown == []
