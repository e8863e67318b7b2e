"""What a run has seen cannot disappear unnoticed: versions, moves, what was forgotten."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.runs import find_missing_documents, newest_documents, publishable, recording

PLACES = ("forgotten", "models/beta/versions", "models/beta/history")


def write(root: Path, count: int) -> None:
    for place in PLACES:
        documents = DocumentFolder(LocalFolder(root / place))
        for _ in range(count):
            documents.append({"number": len(documents.numbers())})


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A root with three documents in each place, seen by a run."""
    write(tmp_path, 3)
    with recording(LocalFolder(tmp_path), "publish", []):
        pass
    return tmp_path


def missing(root: Path) -> list[str]:
    return [path for path, _ in find_missing_documents(LocalFolder(root))]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    "harm",
    [
        lambda folder: (folder / "3.json").unlink(),
        lambda folder: [(folder / f"{number}.json").unlink() for number in (2, 3)],
        shutil.rmtree,
        lambda folder: shutil.copy(folder / "2.json", folder / "3.json"),
    ],
)
def test_what_is_gone_or_replaced_is_told(
    root: Path, place: str, harm: Callable[[Path], object]
) -> None:
    assert missing(root) == []
    harm(root / place)
    assert missing(root) == [place]


def test_documents_since_then_are_no_loss(root: Path) -> None:
    write(root, 2)
    assert missing(root) == []
    assert newest_documents(LocalFolder(root))["forgotten"][0] == 5


def test_a_record_that_says_something_else_anchors_nothing(root: Path) -> None:
    (history,) = (root / "runs").iterdir()
    lines = [
        "{",
        "[]",
        '{"documents": 3}',
        '{"documents": {"forgotten": 7}}',
        '{"documents": {"../../etc/versions": [9, "x"], "models/../versions": [9, "x"]}}',
        '{"documents": {"forgotten": ["many", "x"]}}',
    ]
    history.write_text("\n".join([*lines, history.read_text()]))
    assert missing(root) == []


def test_a_condition_on_a_car_is_not_kept() -> None:
    arguments = ["select", "--cohort", "vehicle_id = 'WVW1'", "--against=drive_id <> 'd'"]
    assert publishable(arguments) == ["select", "--cohort", "***", "***"]
