"""Finds columns by name in a file from a stranger, or says what is there instead."""

import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path

from fleet_slip.errors import InputError
from fleet_slip.words import shown

MAX_COLUMNS = 10_000

_SHOWN_COLUMNS = 30


def require_columns(file: Path, names: Sequence[str], wanted: Iterable[str]) -> dict[str, int]:
    """Return where each wanted column stands. Raises `InputError` for none or two of a name."""
    if len(names) > MAX_COLUMNS:
        raise InputError(
            f"{shown(file)}: {len(names):,} columns, at most {MAX_COLUMNS:,} are read."
        )
    positions: dict[str, int] = {}
    for column in wanted:
        found = [i for i, name in enumerate(names) if name == column]
        if len(found) > 1:
            where = ", ".join(str(i + 1) for i in found[:5])
            raise InputError(
                f"{shown(file)}: {len(found)} columns are called {column!r} (number {where}). "
                "Rename all but one."
            )
        if not found:
            raise InputError(f"{shown(file)}: {describe_missing(column, names)}")
        positions[column] = found[0]
    return positions


def describe_unknown(signal: str, known: Iterable[str]) -> str:
    """Return what to say of a signal that the catalogue does not have."""
    names = list(known)
    near = difflib.get_close_matches(signal, names, n=2, cutoff=0.7)
    near += [name for name in names if signal in name.split("_") and name not in near]
    hint = f" Do you mean {' or '.join(near[:3])}?" if near else ""
    return f"unknown signal {signal!r}.{hint} Known signals: {', '.join(names)}"


def describe_missing(column: str, names: Sequence[str]) -> str:
    """Return what to say of a column that is not among a file's."""
    folded = {name.casefold(): name for name in names}
    matches = difflib.get_close_matches(column.casefold(), folded, n=3, cutoff=0.6)
    near = [folded[match] for match in matches]
    hint = f" Did the mapping mean {' or '.join(repr(name[:80]) for name in near)}?" if near else ""
    there = ", ".join(repr(name[:80]) for name in names[:_SHOWN_COLUMNS])
    more = f" and {len(names) - _SHOWN_COLUMNS:,} more" if len(names) > _SHOWN_COLUMNS else ""
    return f"no column {column!r}.{hint} Its columns are {there}{more}."
