"""What the attacks on readers begin with is sound, and reads as the same drive."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.support.fuzz.logs import AX, BETA, FORMATS, ROWS, sound_file
from tests.support.measured import failure, physical, read_measured, ticks

LINES = ("asc", "candump", "vbo")
"""Formats of which what comes before the cut is read, as of CSV."""


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_says_the_same(tmp_path: Path, name: str) -> None:
    file = tmp_path / f"log{FORMATS[name].suffix}"
    file.write_bytes(sound_file(name))
    log = read_measured(file, FORMATS[name].mapping)
    assert ticks(log) == list(range(ROWS))
    np.testing.assert_allclose(physical(log, "ax", 0.001), AX, atol=1e-6)
    sideslip = physical(log, "sideslip", 0.0001)
    known = np.isfinite(sideslip)
    assert known.sum() == ROWS - ("mdf4" in name)  # whose first value is marked as invalid
    np.testing.assert_allclose(sideslip[known], np.radians(BETA)[known], atol=5.1e-5)


@pytest.mark.parametrize("share", [0.3, 0.7, 0.99])
@pytest.mark.parametrize("name", [name for name in FORMATS if name not in LINES])
def test_a_file_that_was_cut_is_refused(
    tmp_path: Path, name: str, share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"log{FORMATS[name].suffix}"
    content = sound_file(name)
    file.write_bytes(content[: int(share * len(content))])
    message = failure(file, FORMATS[name].mapping)
    assert re.search("Is it complete|ends too early|it is truncated", message)
    assert capfd.readouterr().err == ""
