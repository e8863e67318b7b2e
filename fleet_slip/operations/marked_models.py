"""Marks model versions that were trained on drives erased later.

An erasure examines the versions that exist. A version published during it, on older Gram rows,
is marked until the erasure has ended; then only if one of its drives has no Gram rows any more, or
its drives are unknown.
"""

from collections.abc import Callable, Collection
from functools import cache

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import Hashes
from fleet_slip.errors import FleetSlipError
from fleet_slip.grams.gram_files import hash_names
from fleet_slip.models.manifest import TrainedDrives
from fleet_slip.models.registry import Registry
from fleet_slip.warehouse.erasure_log import ErasureLog
from fleet_slip.warehouse.warehouse import Warehouse


def marked_models(warehouse: Warehouse) -> frozenset[str]:
    """Return the model versions, NAME@VERSION, that were or may have been trained on them."""
    entries = ErasureLog(warehouse.root).entries()
    marked = {name for entry in entries for name in entry.get("models", ())}
    judged: dict[str, dict[str, int]] = {}
    without: dict[str, int | None] = {}
    for entry in entries:
        if entry["event"] == "begun" and "judged" in entry:
            judged[entry["subject"]] = entry["judged"]
            without[entry["subject"]] = None
        elif entry["event"] == "done":
            without[entry["subject"]] = entry.get("grams_version")
    registry = Registry.open(warehouse)
    versions = [(n, number) for n in registry.names() if judged for number in registry.versions(n)]
    hashes = cache(lambda: _hashes_of_present(warehouse))
    present = cache(lambda name: TrainedDrives.from_hashes(name, hashes()).salted)
    for subject, numbers in judged.items():
        marked |= {
            f"{name}@{number}"
            for name, number in versions
            if number > numbers.get(name, 0)
            and _may_have_seen(registry, name, number, without[subject], present)
        }
    return frozenset(marked)


def _hashes_of_present(warehouse: Warehouse) -> Hashes:
    grams = warehouse.grams.snapshot()
    drives = (grams.table.read(file.path, ["drive_id"])["drive_id"] for file in grams.files)
    hashes = [hash_names(names.unique()) for names in drives]
    return np.unique(np.concatenate(hashes)) if hashes else np.array([], dtype=np.uint64)


def _may_have_seen(
    registry: Registry,
    name: str,
    number: int,
    without: int | None,
    present: Callable[[str], Hashes],
) -> bool:
    """Return True if a version may be trained on drives without Gram rows since `without`."""
    if without is None:
        return True
    try:
        manifest = registry.load(name, number).manifest
        trained_here = manifest.imported_from is None
        if trained_here and manifest.trained_on.grams_version >= without:
            return False
        trained = registry.trained_drives(manifest)
        return not bool(np.isin(trained.salted, present(name)).all())
    except FleetSlipError:
        return True


def models_trained_on(warehouse: Warehouse, drives: Collection[str]) -> list[str]:
    """Return the model versions that were trained on one of the drives, or may have been."""
    registry = Registry.open(warehouse)
    hashes = hash_names(pa.array(sorted(drives), pa.string()))
    references: list[str] = []
    for name in registry.names():
        for number in registry.versions(name):
            try:
                trained = registry.trained_drives(registry.load(name, number).manifest)
                is_trained = bool(trained.among(hashes).any())
            except FleetSlipError:
                is_trained = True
            if is_trained:
                references.append(f"{name}@{number}")
    return sorted(references)
