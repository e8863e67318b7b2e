"""The version, the changelog and the tags agree."""

import re
import subprocess
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parents[2]
HEADINGS = re.findall(r"^## (.+)$", (HERE / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
VERSION = re.compile(r"(\d+\.\d+\.\d+) - \d{4}-\d{2}-\d{2}")


def released() -> list[str]:
    return [found[1] for heading in HEADINGS if (found := VERSION.fullmatch(heading))]


def parts(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


def test_the_changelog_goes_by_version_the_newest_first() -> None:
    assert HEADINGS
    assert [one for one in HEADINGS if one != "Unreleased" and not VERSION.fullmatch(one)] == []
    assert "Unreleased" not in HEADINGS[1:]
    assert released() == sorted(set(released()), key=parts, reverse=True)


def test_the_program_is_not_older_than_its_changelog_says() -> None:
    version = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]["version"]
    assert all(parts(version) >= parts(one) for one in released())
    assert HEADINGS[0] == "Unreleased" or version == released()[0]


def test_every_tag_is_a_version_of_the_changelog() -> None:
    listed = subprocess.run(
        ["git", "-C", str(HERE), "tag", "--list", "v*"], capture_output=True, text=True, check=False
    )
    tags = {tag.removeprefix("v") for tag in listed.stdout.split()}  # none where there is no git
    assert tags <= set(released())
