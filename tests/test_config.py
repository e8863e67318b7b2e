"""What is said of a wrong config: in words of our own, key by key."""

from datetime import date
from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field

from fleet_slip.config import Config, load_config
from fleet_slip.errors import ConfigError


class OfColumn(Config):
    column: str


class Example(Config):
    name: str
    kind: Literal["a", "b"] = "a"
    count: int = Field(1, ge=1)
    share: float = Field(0.5, gt=0, lt=1)
    day: date | None = None
    source: str | OfColumn = "x"
    words: tuple[str, ...] = ()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "name: is missing"),
        ("name = 3", "name: must be text"),
        ("name = 'x'\nnmae = 'y'", "nmae: unknown key"),
        ("name = 'x'\nstr = 'y'", "str: unknown key"),
        ("name = 'x'\nkind = 'c'", "kind: must be 'a' or 'b'"),
        ("name = 'x'\ncount = 0", "count: must be at least 1"),
        ("name = 'x'\ncount = 'few'", "count: must be a whole number"),
        ("name = 'x'\nshare = 1.0", "share: must be less than 1"),
        ("name = 'x'\nday = 'May'", "day: must be a date such as 2024-05-31"),
        ("name = 'x'\nsource = 3", "source: must be text, or must be a table"),
        ("name = 'x'\nsource = { colum = 'y' }", "source.colum: unknown key"),
        ("name = 'x'\nwords = [1]", "words.0: must be text"),
    ],
)
def test_a_fault_names_the_key_and_what_it_must_be(text: str, told: str, tmp_path: Path) -> None:
    file = tmp_path / "example.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(file, Example)
    assert told in str(caught.value)
    assert "Input" not in str(caught.value)
