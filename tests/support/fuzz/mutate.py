"""Mutations of bytes, of trees as TOML and JSON hold them, and a few bad words."""

import copy
import datetime
import json
import random
from decimal import Decimal
from pathlib import Path
from typing import Any

_VALUES = json.loads((Path(__file__).parents[2] / "data" / "hostile_values.json").read_text())
WORDS: tuple[str, ...] = (*_VALUES["words"], "é" * 300, "x" * 5000)
"""Names and texts that have broken programs."""

NUMBERS: tuple[float, ...] = tuple(_VALUES["numbers"])
"""Numbers that have: the integers first, then floats."""

HUGE = "@huge"
"""Stands for an integer of more digits than Python converts."""

NESTED = "@nested"
"""Stands for lists in lists, deeper than a parser likes, in what `to_toml` and `to_json` write."""

_NESTED_TEXT = "[" * 5000 + "]" * 5000


def mutate_bytes(rng: random.Random, data: bytes, edges: int = 0) -> bytes:
    """Damage bytes in a few places; `edges` prefers so many bytes at both ends."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        if not changed:
            break
        if edges and rng.random() < 0.7:
            at = rng.choice([0, max(0, len(changed) - edges)]) + rng.randrange(edges)
            at = min(at, len(changed) - 1)
        else:
            at = rng.randrange(len(changed))
        size = rng.choice([1, 1, 1, 4, 16, 100])
        match rng.randrange(7):
            case 0:
                changed[at] ^= 1 << rng.randrange(8)
            case 1:
                changed[at] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)])
            case 2:
                del changed[at:]
            case 3:
                del changed[at : at + size]
            case 4:
                changed[at:at] = bytes(rng.choice([0, 0xFF, 0x22, 0x0A]) for _ in range(size))
            case 5:
                changed[at:at] = changed[at : at + size] * rng.randint(1, 20)
            case _:
                changed[at:at] = rng.choice(WORDS).encode()
    return bytes(changed)


def scalar(rng: random.Random) -> Any:
    """Return a value that nobody expects."""
    match rng.randrange(6):
        case 0 | 1:
            return rng.choice(NUMBERS)
        case 2 | 3:
            return rng.choice([*WORDS, HUGE])
        case 4:
            return rng.choice([True, False, Decimal("1e9999"), datetime.date(1, 1, 1)])
        case _:
            return rng.choice([[], {}, [[]], [1, "a"], NESTED])


def mutate_tree(rng: random.Random, tree: Any) -> Any:
    """Return the tree with one to three values, keys or list lengths changed."""
    changed = copy.deepcopy(tree)
    for _ in range(rng.randint(1, 3)):
        parent = _somewhere(rng, changed)
        if isinstance(parent, dict):
            _mutate_dict(rng, parent)
        elif isinstance(parent, list):
            _mutate_list(rng, parent)
    return changed


def _somewhere(rng: random.Random, tree: Any) -> Any:
    """Return a dictionary or list of the tree; deep ones as often as shallow ones."""
    place = tree
    while True:
        children = place.values() if isinstance(place, dict) else place
        inner = [child for child in children if isinstance(child, dict | list) and child]
        if not inner or rng.random() < 0.3:
            return place
        place = rng.choice(inner)


def _mutate_dict(rng: random.Random, parent: dict[str, Any]) -> None:
    if not parent:
        parent[rng.choice(WORDS)] = scalar(rng)
        return
    key = rng.choice(list(parent))
    match rng.randrange(7):
        case 0:
            del parent[key]
        case 1:
            parent[rng.choice(WORDS)] = parent[key]
        case 2:
            parent[rng.choice(list(parent))] = parent[key]
        case _:
            parent[key] = _neighbour(rng, parent[key])


def _mutate_list(rng: random.Random, parent: list[Any]) -> None:
    if not parent:
        parent.append(scalar(rng))
        return
    at = rng.randrange(len(parent))
    match rng.randrange(5):
        case 0:
            del parent[at]
        case 1:
            parent *= rng.choice([2, 50])
        case 2:
            parent.insert(at, scalar(rng))
        case _:
            parent[at] = _neighbour(rng, parent[at])


def _neighbour(rng: random.Random, value: Any) -> Any:
    """Return another value, often of the same kind: these get further into a program."""
    if isinstance(value, int | float | Decimal) and rng.random() < 0.7:
        factor = rng.choice([0, -1, 2, 1000, 10**6, 10**12])
        return rng.choice([value * factor, *NUMBERS])
    if isinstance(value, str) and rng.random() < 0.5:
        return value + rng.choice(WORDS)
    return scalar(rng)


def to_toml(tree: dict[str, Any]) -> str:
    """Write a tree as TOML."""
    text = "\n".join(f"{_toml_text(key)} = {_toml(value)}" for key, value in tree.items())
    return text.replace(f'"{NESTED}"', _NESTED_TEXT)


def to_json(tree: Any) -> str:
    """Write a tree as JSON, NaN and infinity included as Python does."""
    text = json.dumps(tree, default=str, ensure_ascii=False)
    return text.replace(f'"{NESTED}"', _NESTED_TEXT).replace(f'"{HUGE}"', "9" * 5001)


def _toml(value: Any) -> str:
    text = str(value)
    match value:
        case bool():
            text = text.lower()
        case str():
            text = _toml_text(value)
        case float() | Decimal():
            text = text.lower().replace("infinity", "inf")
        case dict():
            inside = (f"{_toml_text(key)} = {_toml(item)}" for key, item in value.items())
            text = f"{{{', '.join(inside)}}}"
        case list():
            text = f"[{', '.join(map(_toml, value))}]"
    return text


def _toml_text(text: str) -> str:
    escaped = "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text)
    return "9" * 5001 if text == HUGE else f'"{escaped}"'
