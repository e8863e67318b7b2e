"""Numbered documents: a lost, moved, copied or replaced one is an error wherever they are read."""

import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fleet_slip.errors import QuestionError, StorageError
from fleet_slip.storage.documents import (
    DocumentFolder,
    accept_losses,
    find_lost,
)
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.local import LocalFolder
from tests.support.logs import path_of

PATH = "models/m/history"


@pytest.fixture
def place(tmp_path: Path) -> Folder:
    return LocalFolder(tmp_path)


@pytest.fixture
def folder(place: Folder) -> DocumentFolder:
    """Four documents."""
    folder = DocumentFolder(place, PATH)
    for number in range(1, 5):
        folder.append({"n": number})
    return folder


def file(folder: DocumentFolder, number: int) -> Path:
    return path_of(folder.folder) / f"{number}.json"


def anchors(folder: DocumentFolder) -> list[str]:
    return (folder.root / "anchors" / folder.path).names()


@pytest.mark.parametrize("number", [1, 3, 4])
def test_a_lost_document_is_an_error_until_it_is_restored(
    folder: DocumentFolder, number: int
) -> None:
    content = file(folder, number).read_bytes()
    file(folder, number).unlink()
    for use in (folder.numbers, lambda: folder.append({"n": 5})):
        with pytest.raises(StorageError, match=rf"{number}\.json: .*missing.*backup"):
            use()
    assert list(folder.faults()) == [folder.file(number)]
    assert len(list(find_lost(folder.root))) == 1
    file(folder, number).write_bytes(content)
    assert folder.numbers() == [1, 2, 3, 4]
    assert not folder.faults()
    assert folder.append({"n": 5}).number == 5


def test_a_lost_document_of_an_object_store_is_an_error(root: Folder) -> None:
    folder = DocumentFolder(root, PATH)
    for number in range(1, 4):
        folder.append({"n": number})
    folder.folder.delete("3.json")
    with pytest.raises(StorageError, match=r"3\.json: .*missing"):
        folder.numbers()
    accept_losses(root, [PATH])
    assert folder.append({"n": 4}).number == 4
    assert folder.numbers() == [1, 2, 4]


@pytest.mark.parametrize("number", [2, 4])
def test_an_accepted_loss_stays_and_its_number_is_not_taken_again(
    folder: DocumentFolder, number: int
) -> None:
    file(folder, number).unlink()
    assert accept_losses(folder.root, [f"{PATH}/{number}.json"]) == [f"{PATH}/{number}.json"]
    assert folder.numbers() == [n for n in range(1, 5) if n != number]
    assert folder.append({"n": 5}).number == 5
    assert not folder.faults()


@pytest.mark.parametrize("path", [f"{PATH}/2.json", PATH, "", "other", "../x"])
def test_only_a_lost_document_can_be_accepted(folder: DocumentFolder, path: str) -> None:
    with pytest.raises(QuestionError, match="no document is missing"):
        accept_losses(folder.root, [path])


def kill(*_: object) -> None:
    raise KeyboardInterrupt


def test_a_process_killed_before_the_anchor_leaves_a_valid_folder(
    folder: DocumentFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(DocumentFolder, "_anchor", kill)
        with pytest.raises(KeyboardInterrupt):
            folder.append({"n": 5})
    assert folder.numbers() == [1, 2, 3, 4, 5]
    assert not folder.faults()
    folder.append({"n": 6})
    assert anchors(folder) == ["6.sha256"]


def test_writers_and_readers_at_once_see_no_loss(place: Folder) -> None:
    folder = DocumentFolder(place, PATH)

    def write(writer: int) -> None:
        for n in range(10):
            folder.append({"writer": writer, "n": n})
            folder.numbers()

    with ThreadPoolExecutor(4) as executor:
        list(executor.map(write, range(4)))
    assert folder.numbers() == list(range(1, 41))
    assert "40.sha256" in anchors(folder)


def test_a_document_that_a_listing_misses_is_not_lost(
    folder: DocumentFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = LocalFolder.names
    monkeypatch.setattr(
        LocalFolder, "names", lambda self: [n for n in names(self) if n not in ("3.json", "4.json")]
    )
    assert folder.numbers() == [1, 2, 3, 4]


def test_a_number_far_ahead_is_refused_at_once(folder: DocumentFolder) -> None:
    shutil.copy(file(folder, 4), file(folder, 999_999_999))
    with pytest.raises(StorageError, match=r"5\.json \(and 99 more\)"):
        folder.numbers()


def exchange(first: Path, second: Path) -> None:
    contents = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(contents)


def swap(folder: DocumentFolder) -> None:
    exchange(file(folder, 2), file(folder, 3))


def take_from_another_model(folder: DocumentFolder) -> None:
    other = DocumentFolder(folder.root, "models/other/history")
    for _ in range(3):
        other.append({"n": 2})
    shutil.copy(file(other, 2), file(folder, 2))


def state_another_number(folder: DocumentFolder) -> None:
    envelope = json.loads(file(folder, 3).read_text())
    file(folder, 2).write_text(json.dumps(envelope | {"number": 2}))


def state_no_place(folder: DocumentFolder) -> None:
    envelope = json.loads(file(folder, 3).read_text())
    file(folder, 2).write_text(json.dumps({k: envelope[k] for k in ("content", "sha256")}))


@pytest.mark.parametrize(
    "change",
    [swap, take_from_another_model, state_another_number, state_no_place],
)
def test_a_document_counts_in_its_place_alone(
    folder: DocumentFolder, change: Callable[[DocumentFolder], None]
) -> None:
    change(folder)
    with pytest.raises(StorageError, match=r"2\.json: "):
        folder.read(2)
    assert folder.file(2) in folder.faults()


def test_a_newest_document_of_another_root_is_a_fault(
    folder: DocumentFolder, tmp_path: Path
) -> None:
    other = DocumentFolder(LocalFolder(tmp_path / "other"), PATH)
    for _ in range(4):
        other.append({"n": "other"})
    shutil.copy(file(other, 4), file(folder, 4))
    assert "was replaced" in folder.faults()[folder.file(4)]
