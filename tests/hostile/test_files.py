"""Measured files of absurd shape, and links: refused or read, in bounded memory, in place."""

import resource
from pathlib import Path

import pytest

from fleet_slip.errors import InputError
from fleet_slip.ingest.load import ingest_files
from fleet_slip.ingest.log_files import StrayLink, find_logs
from fleet_slip.warehouse.tables import Warehouse
from tests.support.measured import a_mapping, csv_text, good_columns, ingest_file

MIB = 2**20


def test_a_million_columns_are_refused_in_little_memory(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    file = tmp_path / "wide.csv"
    file.write_text(",".join(["t", "ax", "beta", *(f"c{i}" for i in range(10**6))]) + "\n0,1,2\n")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError):
        ingest_file(warehouse, file, a_mapping())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500 * MIB / 1024
    assert not (tmp_path / "data").exists()


def test_a_link_to_a_file_is_read_and_left_alone(warehouse: Warehouse, tmp_path: Path) -> None:
    file = tmp_path / "elsewhere" / "log.csv"
    file.parent.mkdir()
    file.write_text(csv_text(good_columns()))
    link = tmp_path / "link.csv"
    link.symlink_to(file)
    assert ingest_file(warehouse, link, a_mapping()).new
    assert link.is_symlink()
    assert list(file.parent.iterdir()) == [file]
    assert not ingest_file(warehouse, file, a_mapping()).new


@pytest.mark.parametrize("target", ["/dev/zero", "folder", "/proc/self/mem", "nowhere"])
def test_links_to_what_is_no_file_are_refused(
    warehouse: Warehouse, tmp_path: Path, target: str
) -> None:
    (tmp_path / "folder" / "below").mkdir(parents=True)
    (tmp_path / "folder" / "below" / "notes.txt").write_text("no log")
    link = tmp_path / "link.csv"
    link.symlink_to(target)
    with pytest.raises(InputError):
        ingest_file(warehouse, link, a_mapping())
    assert not (tmp_path / "data").exists()


def test_a_link_out_of_a_folder_is_refused_and_holds_nothing_up(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    folder, other = tmp_path / "landing", tmp_path / "private"
    folder.mkdir()
    other.mkdir()
    (folder / "a.csv").write_text(csv_text(good_columns()))
    (other / "secret.csv").write_text(csv_text(good_columns(30)))
    for name, target in {
        "b.csv": other / "secret.csv",
        "c.csv": Path("../private/secret.csv"),
        "d.csv": folder / "b.csv",
        "e.csv": Path("/dev/zero"),
        "f.csv": folder / "a.csv",
    }.items():
        (folder / name).symlink_to(target)
    (folder / "below").symlink_to(other)
    reports = []
    with pytest.raises(
        InputError, match=r"4 files cannot be used; all others .*b\.csv: a symbolic link"
    ):
        reports += list(ingest_files(warehouse, find_logs([folder]), a_mapping()))
    assert warehouse.logs.snapshot().rows == 20


def test_a_pattern_does_not_lead_out_of_its_folder(tmp_path: Path) -> None:
    folder, other = tmp_path / "landing", tmp_path / "private"
    (folder / "sound").mkdir(parents=True)
    other.mkdir()
    for file in (folder / "sound" / "a.csv", other / "secret.csv"):
        file.write_text(csv_text(good_columns()))
    (folder / "below").symlink_to(other)
    found = find_logs([f"{folder}/**/*.csv"])
    strays = {str(file): isinstance(file, StrayLink) for file in found}
    assert strays == {str(folder / "sound/a.csv"): False, str(folder / "below/secret.csv"): True}
    (tmp_path / "link").symlink_to(folder)  # a person's own link to a folder is followed
    assert not isinstance(find_logs([tmp_path / "link" / "sound"])[0], StrayLink)
