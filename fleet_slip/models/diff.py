"""Tells two model versions apart: every entry of their manifests that differs, and the drives."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.rendering import Answer, Part, Remark, TextTable

_LONG = 40
"""Characters of a value in the table; the document has it whole."""


@dataclass(frozen=True)
class Difference(Answer):
    """Two versions, what differs of their manifests, and how many drives made either.

    Attributes:
        facts: values of both by the path of their entry; None where one has no such entry.
        drives: that made only the one, only the other, and both; None of two models.
    """

    one: ModelVersion
    other: ModelVersion
    facts: dict[str, tuple[Any, Any]]
    drives: tuple[int, int, int] | None

    def parts(self) -> Iterator[Part]:
        """Return a table of what differs, and the numbers of drives."""
        one, other = self.one.reference, self.other.reference
        rows = [
            [name, _shown(a), _shown(b)]
            for name, (a, b) in self.facts.items()
            if not name.endswith(("_exact", "sha256"))  # for machines: --json
        ]
        if not rows:
            yield Remark(f"{one} and {other} are the same estimator from the same data")
            return
        yield TextTable("", f"what differs|{one}|{other}", rows, left=3)
        if self.drives:
            only_one, only_other, both = self.drives
            yield Remark(
                f"drives: {both:,} made both, {only_one:,} only {one}, {only_other:,} only {other}"
            )

    def as_dict(self) -> dict[str, Any]:
        """Return what `diff --json` prints."""
        names = ("only_one", "only_other", "both")
        return {
            "one": self.one.reference,
            "other": self.other.reference,
            "drives": dict(zip(names, self.drives, strict=True)) if self.drives else None,
            "facts": {name: {"one": a, "other": b} for name, (a, b) in self.facts.items()},
        }


def compare_versions(registry: Registry, one: ModelVersion, other: ModelVersion) -> Difference:
    """Compare two versions. Raises `StorageError` if what one keeps of its drives is damaged."""
    a, b = (dict(_entries(version)) for version in (one, other))
    names = [name for name in dict.fromkeys([*a, *b]) if a.get(name) != b.get(name)]
    facts = {name: (a.get(name), b.get(name)) for name in names}
    return Difference(one, other, facts, _drives(registry, one, other))


def _entries(version: ModelVersion) -> Iterator[tuple[str, Any]]:
    """Yield the entries of a manifest, terms by their signals."""
    content = version.manifest.model_dump(mode="json")
    content["terms"] = {term.pop("signal"): term for term in content["terms"]}
    return _flat(content, "")


def _flat(content: dict[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", value


def _shown(value: Any) -> str:
    text = "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _LONG else f"{text[: _LONG - 1]}…"


def _drives(
    registry: Registry, one: ModelVersion, other: ModelVersion
) -> tuple[int, int, int] | None:
    if one.manifest.name != other.manifest.name:  # their hashes are salted differently
        return None
    a, b = (registry.trained_drives(version.manifest).salted for version in (one, other))
    both = len(np.intersect1d(a, b, assume_unique=True))
    return len(a) - both, len(b) - both, both
