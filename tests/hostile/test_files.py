"""Measured files of absurd shape, and links: refused or read, in bounded memory, in place."""

import resource
from pathlib import Path

import pytest

from fleet_slip.errors import InputError
from fleet_slip.ingest.landing.ingest_job import ingest_file
from fleet_slip.warehouse.tables import Warehouse
from tests.support.measured import a_mapping, csv_text, good_columns

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


@pytest.mark.parametrize("target", ["/dev/zero", "/", "/proc/self/mem", "nowhere"])
def test_links_to_what_is_no_file_are_refused(
    warehouse: Warehouse, tmp_path: Path, target: str
) -> None:
    link = tmp_path / "link.csv"
    link.symlink_to(target)
    with pytest.raises(InputError):
        ingest_file(warehouse, link, a_mapping())
    assert not (tmp_path / "data").exists()
