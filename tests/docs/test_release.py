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


def git(folder: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(folder), *words], capture_output=True, text=True, check=False
    )
    return done.stdout


def tags_that_nothing_tells_of(folder: Path) -> set[str]:
    """Return the tags of a repository that are no version of the changelog; none without git."""
    tags = git(folder, "tag", "--list", "v*").split()
    return {tag.removeprefix("v") for tag in tags} - set(released())


def test_every_tag_is_a_version_of_the_changelog() -> None:
    assert tags_that_nothing_tells_of(HERE) == set()


def test_a_tag_that_the_changelog_does_not_know_is_noticed(tmp_path: Path) -> None:
    author = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, *author, "commit", "--quiet", "--allow-empty", "--message", "A release")
    for version in (*released(), "99.0.0"):
        git(tmp_path, "tag", f"v{version}")
    assert tags_that_nothing_tells_of(tmp_path) == {"99.0.0"}
