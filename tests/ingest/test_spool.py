"""What is kept aside comes back in order, and leaves nothing behind."""

import errno
import os
import tempfile
from pathlib import Path

import pytest

from fleet_slip.errors import InputError
from fleet_slip.ingest.formats import source
from fleet_slip.ingest.formats.source import Spool


@pytest.mark.parametrize("in_memory", [1, 2**20])
def test_pieces_come_back_by_key_and_no_file_has_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_memory: int
) -> None:
    monkeypatch.setattr(source, "IN_MEMORY_BYTES", in_memory)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    kept = Spool()
    for number in range(10):
        kept.add(number % 3, b"%d" % number * number)
    assert list(kept.read(1)) == [b"1", b"4444", b"7777777"]
    assert list(tmp_path.iterdir()) == []
    kept.clear()
    assert list(kept.read(1)) == []
    kept.add(1, b"again")
    assert list(kept.read(1)) == [b"again"]
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_an_error_that_names_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    kept = Spool()
    kept._file.close()
    kept._file = _Full()  # type: ignore[assignment]
    with pytest.raises(InputError, match=r"no room for a temporary copy .*TMPDIR") as caught:
        kept.add(1, b"much")
    assert str(caught.value).startswith(str(tmp_path))


class _Full:
    """A file on a disk that is full."""

    def seek(self, place: int) -> int:
        return place

    def write(self, _: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
