"""Tells two model versions apart: what each was made of, and what it came to."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from fleet_slip.catalogue.facts import RECEIVED
from fleet_slip.grams.gram_rows import hash_numbers
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.score import cohort_of_rows
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.warehouse.condition import Condition, asking, drive_columns
from fleet_slip.warehouse.database import sql_text
from fleet_slip.warehouse.tables import Warehouse, connect_tables


@dataclass(frozen=True)
class CommonDrives:
    """How many drives made the one version, the other, and both."""

    only_one: int
    only_other: int
    both: int


@dataclass(frozen=True)
class Term:
    """A coefficient of two versions, in SI units; None where a model does not have the signal."""

    signal: str
    unit: str
    one: float | None
    other: float | None
    same: bool

    @property
    def cells(self) -> list[str]:
        """Signal, unit and coefficients, with more digits where few would hide a difference."""
        values = (self.one, self.other)
        short = ["" if value is None else f"{value:.6g}" for value in values]
        if self.same:
            short[1] = "the same"
        elif short[0] == short[1]:
            short = [repr(value) for value in values]
        return [self.signal, self.unit, *short]


@dataclass(frozen=True)
class Difference(Answer):
    """Two versions: facts and terms of either, and shared drives, None where these are not kept."""

    one: ModelVersion
    other: ModelVersion
    drives: CommonDrives | None
    facts: dict[str, tuple[Any, Any]]
    terms: tuple[Term, ...] = field(repr=False)

    def parts(self) -> Iterator[Part]:
        """Return tables of coefficients and facts, and how many drives both were made of."""
        one, other = self.one.reference, self.other.reference
        if not self.facts and all(term.same for term in self.terms):
            yield Remark(f"{one} and {other} are the same estimator from the same data")
            return
        terms = [term.cells for term in self.terms]
        yield TextTable("", f"signal|unit|{one}|{other}", terms, left=2)
        if (shared := self.drives) is not None:
            yield Remark(
                f"drives: {shared.both:,} made both, {shared.only_one:,} only {one}, "
                f"{shared.only_other:,} only {other}"
            )
        rows = [
            [name.rpartition(".")[2].replace("_", " "), _shown(a), _shown(b)]
            for name, (a, b) in self.facts.items()
            if not name.endswith("sha256")  # for machines: --json
        ]
        yield TextTable("", f"what differs|{one}|{other}", rows, left=3)

    def as_dict(self) -> dict[str, Any]:
        """Return what `diff --json` prints."""
        shared = self.drives
        return {
            "one": self.one.reference,
            "other": self.other.reference,
            "drives": vars(shared) if shared else None,
            "facts": {name: {"one": a, "other": b} for name, (a, b) in self.facts.items()},
            "terms": [vars(term) for term in self.terms],
        }


def _shown(value: Any) -> str:
    match value:
        case None:
            return ""
        case dict():
            return ", ".join(f"{name} {inner}" for name, inner in value.items())
        case float():
            return f"{value:.6g}"
        case _:
            return str(value)


def compare_versions(registry: Registry, one: ModelVersion, other: ModelVersion) -> Difference:
    """Compare two versions. Raises `StorageError` if what one keeps of its drives is damaged."""
    return Difference(
        one, other, _drives(registry, one, other), _facts(one, other), tuple(_terms(one, other))
    )


def _drives(registry: Registry, one: ModelVersion, other: ModelVersion) -> CommonDrives | None:
    if one.manifest.name != other.manifest.name:  # their hashes are salted differently
        return None
    made = [registry.trained_drives(version.manifest) for version in (one, other)]
    a, b = (drives.salted if drives else None for drives in made)
    if a is None or b is None:
        return None
    both = len(np.intersect1d(a, b, assume_unique=True))
    return CommonDrives(len(a) - both, len(b) - both, both)


def _facts(one: ModelVersion, other: ModelVersion) -> dict[str, tuple[Any, Any]]:
    a, b = (_flat(version.manifest) for version in (one, other))
    names = dict.fromkeys([*a, *b])
    return {name: (a.get(name), b.get(name)) for name in names if a.get(name) != b.get(name)}


def _flat(manifest: Manifest) -> dict[str, Any]:
    parts = manifest.model_dump(
        mode="json", include={"trained_on", "cross_validation", "selected_by"}
    )
    inner = {f"{part}.{name}": value for part in parts for name, value in parts[part].items()}
    own = {"package_version": manifest.package_version, "through_origin": manifest.through_origin}
    return {**own, **inner}


def _terms(one: ModelVersion, other: ModelVersion) -> list[Term]:
    a, b = (_coefficients(version.manifest) for version in (one, other))
    found = []
    for signal in dict.fromkeys([*a, *b]):
        exact, unit = zip(*(side[signal] for side in (a, b) if signal in side), strict=True)
        values = [float(side[signal][0]) if signal in side else None for side in (a, b)]
        same = len(exact) == 2 and exact[0] == exact[1]
        found.append(Term(signal, unit[0], values[0], values[1], same))
    return found


def _coefficients(manifest: Manifest) -> dict[str, tuple[Fraction, str]]:
    label = manifest.label
    terms = {term.column: (term.coefficient_exact, term.unit) for term in manifest.terms}
    return {"intercept": (manifest.intercept_exact, label.unit), **terms}


# Which drives of a cohort a version was trained on, and those that it was not.


@dataclass(frozen=True)
class SeenDrives:
    """A cohort's drives, those that made a version (None: not kept), the condition of others."""

    drives: int
    trained: int | None
    others: Condition


def find_seen(
    warehouse: Warehouse, registry: Registry, manifest: Manifest, condition: str | Condition
) -> SeenDrives:
    """Return which drives with a log of a cohort of rows made a version. Raises as `score`."""
    cohort = cohort_of_rows(condition)
    view = "log" if cohort.columns - set(drive_columns()) else "drives"
    logged = f"({cohort.sql}) AND source <> '{RECEIVED}'"
    query = f"SELECT DISTINCT drive_id FROM {view} WHERE {logged} ORDER BY 1"
    with connect_tables(warehouse, query) as database, asking(database, cohort):
        names = database.sql(query).to_arrow_table()["drive_id"]
    made = registry.trained_drives(manifest)
    if made is None:
        return SeenDrives(len(names), None, cohort)
    seen = made.among(hash_numbers(names))
    if not seen.any() or seen.all():
        return SeenDrives(len(names), int(seen.sum()), cohort)
    kept = [name for name, old in zip(names.to_pylist(), seen, strict=True) if not old]
    listed = ", ".join(map(sql_text, kept))
    others = Condition(cohort.text, f"({cohort.sql} AND drive_id IN ({listed}))")
    return SeenDrives(len(names), int(seen.sum()), others)
