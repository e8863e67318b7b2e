"""`base` and `rendering`: canonical JSON, dates, and results as JSON documents."""

import json
import math
from dataclasses import dataclass
from datetime import date, datetime
from decimal import Decimal
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from fleet_slip.base import (
    Record,
    canonical_ascii,
    canonical_json,
    date_of,
    document_of,
    last_day,
    sha256_of,
)
from fleet_slip.config import Config, load_config
from fleet_slip.errors import ConfigError, UsageError


@dataclass(frozen=True)
class Inner:
    size: int
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outer(Record):
    DOCUMENT = "label length=inner.size none=nothing.size *inner names_of=inner.names? twice"

    label: str
    inner: Inner
    nothing: Inner | None = None

    @property
    def twice(self) -> dict[str, float | Decimal]:
        return {"whole": Decimal("2.0"), "part": Decimal("2.5"), "unknown": math.nan}


@dataclass(frozen=True)
class Plain(Record):
    outer: Outer | None = None


def test_a_class_names_what_its_document_has() -> None:
    assert Outer("a", Inner(3)).as_dict() == {
        "label": "a",
        "length": 3,
        "none": None,
        "size": 3,
        "names": [],
        "twice": {"whole": 2, "part": 2.5, "unknown": None},
    }
    assert Outer("a", Inner(3, ("b",))).as_dict()["names_of"] == ["b"]


def test_without_words_all_fields_are_there() -> None:
    assert Plain().as_dict() == {"outer": None}
    assert document_of([Plain(Outer("a", Inner(3)))])[0]["outer"]["label"] == "a"


CONTENT = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(codec="utf-8"), max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=8,
)


def test_the_texts_are_those_that_checksums_were_always_taken_from() -> None:
    content = {"b": [1, 0.5, None], "a": {"ü": "β", "A": True}}
    assert canonical_json(content) == '{"a":{"A":true,"ü":"β"},"b":[1,0.5,null]}'
    assert canonical_ascii(content) == r'{"a":{"A":true,"\u00fc":"\u03b2"},"b":[1,0.5,null]}'
    # FIPS 180-2, appendix B.1.
    assert sha256_of("abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


@given(st.dictionaries(st.text(max_size=4), CONTENT, max_size=4))
def test_the_order_of_keys_does_not_matter_and_nothing_is_lost(content: dict[str, object]) -> None:
    turned = dict(reversed(content.items()))
    for canonical in (canonical_json, canonical_ascii):
        assert canonical(content) == canonical(turned)
        assert json.loads(canonical(content)) == content
    assert canonical_ascii(content).isascii()


@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf")])
def test_numbers_that_json_has_not_are_refused(number: float) -> None:
    for canonical in (canonical_json, canonical_ascii):
        with pytest.raises(ValueError, match="JSON compliant"):
            canonical({"value": number})


DAY = date(2024, 5, 6)


@pytest.mark.parametrize("day", [DAY, "2024-05-06", datetime(2024, 5, 6, 23, 59)])
def test_a_day_is_a_date_a_text_or_the_day_of_a_time(day: date | str) -> None:
    assert date_of(day, "since") == DAY
    assert type(date_of(day, "since")) is date


def test_none_is_no_day_and_today_may_be_a_last_day() -> None:
    assert date_of(None, "since") is None
    assert last_day("today") == date.today()


def test_an_invalid_date_is_refused_with_an_example() -> None:
    with pytest.raises(UsageError, match=r"since 6 May: not a date; write it as 2024-05-01\."):
        date_of("6 May", "since")
    with pytest.raises(UsageError, match="write it as 2024-05-01, or today"):
        last_day("soon")


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
    ("text", "fault"),
    [
        ("", "name: is missing"),
        ("name = 3", "name: must be a valid string"),
        ("name = 'x'\nnmae = 'y'", "nmae: unknown key"),
        ("name = 'x'\nkind = 'c'", "kind: must be 'a' or 'b'"),
        ("name = 'x'\ncount = 0", "count: must be greater than or equal to 1"),
        ("name = 'x'\nshare = 1.0", "share: must be less than 1"),
        ("name = 'x'\nsource = 3", "source: must be a valid string, or must be a valid dictionary"),
        ("name = 'x'\nsource = { colum = 'y' }", "source.colum: unknown key"),
        ("name = 'x'\nwords = [1]", "words.0: must be a valid string"),
    ],
)
def test_a_fault_names_the_key_and_what_it_must_be(text: str, fault: str, tmp_path: Path) -> None:
    file = tmp_path / "example.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(file, Example)
    assert fault in str(caught.value)
    assert "Input" not in str(caught.value)
