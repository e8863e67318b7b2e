"""Compares names with `vocabulary.toml`, the usual names of signals and units."""

import re
import tomllib
from collections.abc import Iterable
from functools import cache, lru_cache
from importlib.resources import files
from typing import Any

CORNERS = ("fl", "fr", "rl", "rr")
_PARTS = re.compile(r"[FRVH][LR](?=wh|rad|sp)|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_UMLAUTS = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"}
)
_IN_BRACKETS = re.compile(r"\s*[\[(<{]\s*([^\[\](){}<>]*?)\s*[\])>}]\s*$")
_NUMBERING = {"id", "nr", "no", "num", "number", "nummer", "name", "code"}


@cache
def vocabulary() -> dict[str, Any]:
    """Return the words by section, those of wheels at each corner under `signals`."""
    text = (files(__package__) / "vocabulary.toml").read_text(encoding="utf-8")
    words = tomllib.loads(text)
    wheels = words["wheels"]
    for corner in CORNERS:
        places = [f"{word} {alias}" for word in wheels["words"] for alias in wheels[corner]]
        words["signals"][f"wheel_{corner}"] = places
        words["never"][f"wheel_{corner}"] = words["never"]["wheels"]
    for corner in ("fl", "fr"):
        words["signals"][f"steer_{corner}"] = [f"steer {alias}" for alias in wheels[corner]]
    return words


def parts_of(name: str) -> list[str]:
    """Return the parts of a name, in lower case: WhlSpdFL is whl, spd, fl."""
    return [part.lower() for part in _PARTS.findall(name.translate(_UMLAUTS))]


@lru_cache(maxsize=2**10)
def split_unit(name: str) -> tuple[str, str]:
    """Return a name without its unit in brackets, and that unit or ''."""
    match = _IN_BRACKETS.search(name)
    return (name[: match.start()], match[1]) if match else (name, "")


@lru_cache(maxsize=2**10)
def unit_called(text: str) -> str | None:
    """Return a unit as a mapping writes it, None for an unknown one."""
    plain = text.strip().strip("[]()<>{} ").lower().replace("·", "*")
    called = {alias: unit for unit, aliases in vocabulary()["units"].items() for alias in aliases}
    return called.get(plain)


@lru_cache(maxsize=2**10)
def unit_behind(name: str) -> str | None:
    """Return the unit at the end of a name, after a blank, a point or an underscore."""
    patterns = vocabulary()["suffixes"].items()
    return next((u for u, end in patterns if re.search(rf"[_\s.](?:{end})$", name.lower())), None)


@lru_cache(maxsize=2**14)
def best_words(signal: str, name: str, section: str = "signals") -> tuple[float, str]:
    """Return the score of a name for the words of a signal, 0 for no match, and the words.

    Words after the name of a message or a topic count twice; unexplained parts of them lower the
    score.
    """
    plain, _ = split_unit(name)
    behind = re.split("[./]", plain, maxsplit=1)[-1] or plain
    exact, prefixes = _never(signal)
    for pieces in _stems_of(behind):
        if any(part in exact or part.startswith(prefixes) for part in pieces):
            return 0.0, ""
    called = _called(signal, section)
    return max(
        ((_fit(words, behind, plain), " ".join(words)) for words in called), default=(0.0, "")
    )


@cache
def _never(signal: str) -> tuple[frozenset[str], tuple[str, ...]]:
    """Return the words that exclude a signal: whole parts of names, and beginnings of parts."""
    never = vocabulary()["never"]
    words = {*never["all"], *never.get(signal, ())}
    return frozenset(words), tuple(word for word in words if len(word) > 4)


@cache
def _called(signal: str, section: str) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(words.split()) for words in vocabulary()[section].get(signal, ()))


def fits_any(words: Iterable[str], name: str) -> bool:
    """Return True if a name has one of the words."""
    plain, _ = split_unit(name)
    return any(_fit(tuple(phrase.split()), plain, plain) > 0 for phrase in words)


def is_called(words: Iterable[str], name: str) -> bool:
    """Return True if a name is one of the words, with a number or not."""
    parts = [part for part in parts_of(split_unit(name)[0]) if not part.isdigit()]
    significant = [part for part in parts if part not in _NUMBERING]
    return any(
        significant == [w for w in phrase.split() if w not in _NUMBERING] for phrase in words
    )


def _fit(words: tuple[str, ...], name_without_unit: str, full_name: str) -> float:
    score, explained = 0.0, set()
    for word in words:
        place = _place(word, name_without_unit)
        if place is not None:
            score += 2 * len(word)
            explained.add(place)
        elif name_without_unit != full_name and _place(word, full_name) is not None:
            score += len(word)
        else:
            return 0.0
    return max(score - 0.5 * (len(_stems_of(name_without_unit)) - len(explained)), 0.1)


@lru_cache(maxsize=2**14)
def _place(word: str, name: str) -> int | None:
    """Return which part of a name has a word, or begins with it."""
    for place, pieces in enumerate(_stems_of(name)):
        if any(p == word or (len(word) > 2 and p.startswith(word)) for p in pieces):
            return place
    return None


@lru_cache(maxsize=2**10)
def _stems_of(name: str) -> list[list[str]]:
    """Return each part of a name, and the words that it is compounded of."""
    return [[part, *_pieces(part)] for part in parts_of(name)]


@lru_cache(maxsize=2**12)
def _pieces(part: str) -> tuple[str, ...]:
    """Return the stems that a part consists of; empty if they do not cover the part."""
    if not part:
        return ()
    for stem in _stems():
        if part == stem:
            return (stem,)
        if part.startswith(stem) and (following := _pieces(part[len(stem) :])):
            return (stem, *following)
    return ()


@cache
def _stems() -> tuple[str, ...]:
    return tuple(sorted(vocabulary()["words"]["stems"], key=len, reverse=True))
