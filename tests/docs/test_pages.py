"""Pages describe the repository correctly, and their links have targets."""

import inspect
import pkgutil
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from markdown_it import MarkdownIt

import fleet_slip
from fleet_slip import Fleet, FleetCohort
from fleet_slip.api.fleet_evaluation import FleetEvaluation
from fleet_slip.api.fleet_maintenance import FleetMaintenance
from fleet_slip.api.fleet_models import FleetModels
from fleet_slip.cli.app import GROUPS

HERE = Path(__file__).resolve().parents[2]
DOCS = HERE / "docs"
AT_THE_TOP = [HERE / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PACKAGE = HERE / "fleet_slip"


def rows_of(page: Path, heading: str) -> list[list[str]]:
    """Return the cells of the table that has this first heading."""
    lines = page.read_text().splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith(f"| {heading} |"))
    rows = []
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def names_of(page: Path, heading: str) -> list[str]:
    return [cells[0].strip("`") for cells in rows_of(page, heading)]


def test_the_architecture_lists_every_folder_once_and_none_besides() -> None:
    folders = {f"{path.parent.name}/" for path in PACKAGE.glob("*/__init__.py")}
    listed = names_of(DOCS / "architecture.md", "folder")
    assert len(listed) == len(set(listed))
    assert set(listed) == folders


def test_the_architecture_lists_folders_in_the_order_that_is_enforced() -> None:
    tools = tomllib.loads((HERE / "pyproject.toml").read_text())["tool"]
    package, *_ = tools["importlinter"]["contracts"]
    folders = names_of(DOCS / "architecture.md", "folder")
    layers = [f"{name}/" for layer in reversed(package["layers"]) for name in layer.split(" | ")]
    assert folders == [name for name in layers if name in folders]


def test_the_architecture_lists_every_module_at_the_top_once_and_none_besides() -> None:
    listed = names_of(DOCS / "architecture.md", "module at the top level")
    assert sorted(listed) == sorted(path.name for path in PACKAGE.glob("*.py"))


def test_the_architecture_names_what_exists() -> None:
    page = DOCS / "architecture.md"
    for name in names_of(page, "folder beside the package"):
        assert (HERE / name).is_dir(), name
    rows = rows_of(page, "section of the paper")
    named = [name for _, *cells in rows for cell in cells for name in re.findall("`(.+?)`", cell)]
    for name in named:
        places = (HERE, PACKAGE, HERE / "configs/scenarios")
        assert any(list(place.glob(name.rstrip("/"))) for place in places), name
    for _, where, functions, _ in rows_of(page, "step"):
        text = "".join((PACKAGE / name).read_text() for name in re.findall("`(.+?)`", where))
        for name in re.findall(r"`(?:\w+\.)?(\w+)`", functions):
            assert re.search(rf"def {name}\(", text), name


def test_the_diagram_names_commands_and_folders_that_exist() -> None:
    text = (DOCS / "images" / "flow.svg").read_text()
    boxes = re.findall(
        r'fill="(#\w+)" stroke=[^\n]*\n<text[^>]*>([^<]*)</text><text[^>]*>([^<]*)<', text
    )
    steps = [(title, subtitle) for fill, title, subtitle in boxes if fill == "#e3ecf7"]
    assert len(steps) > 5
    commands = {name for group in GROUPS.values() for name in group.split()}
    places = {path.stem for path in PACKAGE.iterdir()}
    for title, subtitle in steps:
        assert set(title.split(", ")) - {"Python"} <= commands
        assert set(subtitle.partition(":")[0].split(", ")) <= places


def test_folder_and_section_agree_in_both_directions() -> None:
    page = DOCS / "architecture.md"
    sections = {
        name
        for _, cell, _ in rows_of(page, "section of the paper")
        for name in re.findall("`(.+?)`", cell)
    }
    back = {cells[0].strip("`") for cells in rows_of(page, "folder") if cells[2]}
    assert sections == back


def pages_in(nav: list[Any]) -> list[str]:
    """Return the pages of a navigation, in order."""
    pages: list[str] = []
    for entry in nav:
        target = entry if isinstance(entry, str) else next(iter(entry.values()))
        pages += [target] if isinstance(target, str) else pages_in(target)
    return pages


def test_the_navigation_has_every_page_once_and_none_besides() -> None:
    site = tomllib.loads((HERE / "zensical.toml").read_text())["project"]
    listed = pages_in(site["nav"])
    assert sorted(listed) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_the_reference_has_what_is_public_and_no_more() -> None:
    """The names of the package, errors, and what the calls of a fleet and a cohort return."""
    shown = re.findall(r"^::: (\S+)$", (DOCS / "api/index.md").read_text(), re.MULTILINE)
    assert list((DOCS / "api").iterdir()) == [DOCS / "api/index.md"]
    calls: list[Any] = [
        call.fget if isinstance(call, property) else call
        for owner in (Fleet, FleetCohort, FleetModels, FleetEvaluation, FleetMaintenance)
        for name, call in inspect.getmembers(owner)
        if not name.startswith("_") and (callable(call) or isinstance(call, property))
    ]
    annotations = " ".join(str(inspect.signature(call).return_annotation) for call in calls)
    public = set(re.findall(r"[A-Z]\w+", annotations)) - set(fleet_slip.__all__)
    package_names = public - {"Any", "DuckDBPyRelation", "None", "Path", "Table"}
    assert shown[:2] == ["fleet_slip", "fleet_slip.errors"]
    assert {name.rpartition(".")[2] for name in shown[2:]} == package_names
    for name in shown[2:]:
        assert pkgutil.resolve_name(name).__module__ == name.rpartition(".")[0]


def targets(page: Path) -> list[str]:
    """Return what a page links to and the pictures that it shows, without other sites."""
    inline = MarkdownIt("commonmark").enable("table").parse(page.read_text())
    links = [
        str(child.attrs.get("href") or child.attrs.get("src"))
        for token in inline
        for child in token.children or []
        if child.type in ("link_open", "image")
    ]
    return [target for target in links if "://" not in target]


@pytest.mark.parametrize("page", AT_THE_TOP, ids=lambda page: page.name)
def test_links_outside_the_site_lead_somewhere(page: Path) -> None:
    """Links between pages, and their anchors, are checked by `make docs`."""
    missing = [target for target in targets(page) if not (HERE / target.partition("#")[0]).exists()]
    assert missing == []


def test_pages_link_to_nothing_that_the_site_lacks() -> None:
    outside = [
        f"{page.relative_to(HERE)}: {target}"
        for page in DOCS.rglob("*.md")
        for target in targets(page)
        if not (page.parent / target.partition("#")[0]).resolve().is_relative_to(DOCS)
    ]
    assert outside == []


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: page.name)
def test_no_row_of_a_table_stands_apart(page: Path) -> None:
    """After a blank line it would be text with bars."""
    blocks = MarkdownIt("commonmark").enable("table").parse(page.read_text())
    assert [block.content for block in blocks if block.content.startswith("| ")] == []


def test_the_readme_is_short() -> None:
    assert len((HERE / "README.md").read_text().splitlines()) <= 120


@pytest.mark.parametrize(
    "page", [*AT_THE_TOP, *sorted(DOCS.rglob("*.md"))], ids=lambda page: page.name
)
def test_paths_of_the_package_exist(page: Path) -> None:
    """A page that names a module names one that is there."""
    named = re.findall(
        r"\b((?:fleet_slip|tests|configs|jobs|benchmarks)/[\w/.-]*\.\w+)\b", page.read_text()
    )
    assert [name for name in named if not (HERE / name).exists()] == []


HEADINGS = re.findall(r"^## (.+)$", (HERE / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
VERSION = re.compile(r"(\d+\.\d+\.\d+) - \d{4}-\d{2}-\d{2}")


def released() -> list[str]:
    return [match[1] for heading in HEADINGS if (match := VERSION.fullmatch(heading))]


def parts(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


def test_the_changelog_goes_by_version_the_newest_first() -> None:
    assert HEADINGS
    assert [
        heading
        for heading in HEADINGS
        if heading != "Unreleased" and not VERSION.fullmatch(heading)
    ] == []
    assert "Unreleased" not in HEADINGS[1:]
    assert released() == sorted(set(released()), key=parts, reverse=True)


def test_the_program_is_not_older_than_its_changelog_says() -> None:
    version = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]["version"]
    assert all(parts(version) >= parts(release) for release in released())
    assert HEADINGS[0] == "Unreleased" or version == released()[0]
