"""The one text of JSON content, whatever its order and layout, and the checksum of a text."""

import hashlib
import json
from typing import Any

_TEXT = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
_ASCII = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False)


def canonical_json(content: Any) -> str:
    """Return JSON with sorted keys, no spaces, no escapes. Raises `ValueError` for NaN."""
    return _TEXT.encode(content)


def canonical_ascii(content: Any) -> str:
    """Return `canonical_json` with escapes beyond ASCII, for checksums of older documents."""
    return _ASCII.encode(content)


def sha256_of(text: str) -> str:
    """Return the SHA-256 of a text in UTF-8, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()
