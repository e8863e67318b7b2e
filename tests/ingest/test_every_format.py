"""What the attacks on readers begin with is sound, and reads as the same drive."""

from pathlib import Path

import numpy as np
import pytest

from tests.support.fuzz.logs import AX, FORMATS, ROWS, sound_file
from tests.support.measured import physical, read_measured, ticks


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_says_the_same(tmp_path: Path, name: str) -> None:
    file = tmp_path / f"log{FORMATS[name].suffix}"
    file.write_bytes(sound_file(name))
    log = read_measured(file, FORMATS[name].mapping)
    assert ticks(log) == list(range(ROWS))
    np.testing.assert_allclose(physical(log, "ax", 0.001), AX, atol=1e-6)
