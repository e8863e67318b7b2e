"""Canonical JSON: one text for one content, the same as ever, since checksums are taken from it."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.base import canonical_ascii, canonical_json, sha256_of

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
