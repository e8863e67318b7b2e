"""Installed packages are the pinned ones, are compatible, and have usable licences.

Known vulnerabilities are looked up by `pip-audit`, which needs a network; this does not.
"""

import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support.commands import run

REPOSITORY = Path(__file__).parents[2]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"].values()
SHIPPED = [*PROJECT["project"]["dependencies"], *chain(*EXTRAS)]
GROUPS = PROJECT["dependency-groups"]
LICENCES = re.compile(
    r"MIT|BSD|Apache|PSF|Python Software Foundation|ISC|MPL|Mozilla|Zlib|0BSD|CC0|LGPL", re.I
)
IMPORTED = re.compile(r"^\s*(?:from|import) (\w+)", re.MULTILINE)


def pinned() -> dict[str, str]:
    """The version that each package is pinned to."""
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    pins = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {canonicalize_name(name): version for name, version in pins}


def required(*requirements: str) -> dict[str, str | None]:
    """These packages and all that they need; without a version where one is not installed."""
    markers: dict[str, str | None] = {}
    waiting = [Requirement(text) for text in requirements]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        try:
            package = distribution(name)
        except PackageNotFoundError:
            markers[name] = None  # of an extra or a group that is not installed here
            continue
        extras = requirement.extras or {""}
        for text in package.requires or ():
            needed = Requirement(text)
            marker = needed.marker
            applies = marker is None or any(marker.evaluate({"extra": e}) for e in extras)
            if applies and canonicalize_name(needed.name) not in markers:
                waiting.append(needed)
        markers[name] = package.version
    return markers


def everything() -> dict[str, str | None]:
    """The packages that users and developers install."""
    return required("pip", "uv", *SHIPPED, *chain(*GROUPS.values()))


def test_installed_versions_are_the_pinned_ones() -> None:
    installed = {name: version for name, version in everything().items() if version}
    assert {name: pinned().get(name) for name in installed} == installed


@pytest.mark.long  # after `make docs`
@pytest.mark.skipif(
    any(required(*GROUPS["docs"])[name] is None for name in required(*GROUPS["docs"])),
    reason="what the group docs needs is known once it is installed: make docs",
)
def test_nothing_is_pinned_that_nothing_needs() -> None:
    assert pinned().keys() - everything().keys() == set()


@pytest.mark.parametrize(
    ("folders", "groups"), [(["fleet_slip"], []), (["tests", "benchmarks"], list(GROUPS))]
)
def test_imported_packages_are_declared(folders: list[str], groups: list[str]) -> None:
    stated = [*SHIPPED, *chain(*(GROUPS[group] for group in groups))]
    declared = {canonicalize_name(Requirement(text).name) for text in stated}
    providers = packages_distributions()
    files = chain(*((REPOSITORY / folder).rglob("*.py") for folder in folders))
    imported = set().union(*map(modules_of, files)) & providers.keys()
    undeclared = {m for m in imported if not declared & set(map(canonicalize_name, providers[m]))}
    assert undeclared - {"fleet_slip", *sys.stdlib_module_names} == set()


def modules_of(file: Path) -> set[str]:
    """The top-level modules that a file imports, one a statement and one statement a line."""
    return set(IMPORTED.findall(file.read_text()))


def test_the_packages_fit_together() -> None:
    command = [sys.executable, "-m", "pip", "check", "--disable-pip-version-check"]
    done = run(command)
    assert done.exit_code == 0, done.stdout


def test_every_licence_lets_us_use_the_package() -> None:
    unknown = []
    for name in (name for name, version in required(*SHIPPED).items() if version):
        metadata = distribution(name).metadata.json
        stated = [metadata.get("license_expression", ""), str(metadata.get("license", ""))[:200]]
        stated += [text for text in metadata.get("classifier", []) if text.startswith("License")]
        if not LICENCES.search(" ".join(map(str, stated))):
            unknown.append(name)
    assert unknown == []


UV = Path(sys.executable).with_name("uv")


@pytest.mark.long  # asks a registry
@pytest.mark.skipif(not UV.exists(), reason="uv is not here")
@pytest.mark.parametrize("extra", PROJECT["project"]["optional-dependencies"])
def test_an_extra_installs_under_the_constraints(tmp_path: Path, extra: str) -> None:
    assert run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path)]).exit_code == 0
    python = str(tmp_path / "bin/python")
    constraints = ["--constraint", str(REPOSITORY / "constraints.txt")]
    install = [str(UV), "pip", "install", "--python", python, *constraints]
    done = run([*install, f"{REPOSITORY}[{extra}]"])
    assert done.exit_code == 0, done.stderr
    assert "yanked" not in done.stderr
    assert run([str(UV), "pip", "check", "--python", python]).exit_code == 0
    assert run([str(tmp_path / "bin/fleet-slip"), "--version"]).exit_code == 0
