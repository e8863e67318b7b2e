"""Results as JSON documents: what the words of `DOCUMENT` mean."""

import math
from dataclasses import dataclass
from decimal import Decimal

from fleet_slip.base import Record, document_of


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
    one: Outer | None = None


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
    assert Plain().as_dict() == {"one": None}
    assert document_of([Plain(Outer("a", Inner(3)))])[0]["one"]["label"] == "a"
