"""Which model versions were trained on drives that were forgotten since.

Who forgets judges the versions there are. One published meanwhile, of older Gram rows, counts as
trained on them until the erasure is done; then if one of its own drives, or an unknown one, has no
Gram rows any more.
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
    found = {name for entry in entries for name in entry.get("models", ())}
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
        found |= {
            f"{name}@{number}"
            for name, number in versions
            if number > numbers.get(name, 0)
            and _may_have_seen(registry, name, number, without[subject], present)
        }
    return frozenset(found)


def _hashes_of_present(warehouse: Warehouse) -> Hashes:
    grams = warehouse.grams.snapshot()
    drives = (grams.table.read(file.path, ["drive_id"])["drive_id"] for file in grams.files)
    found = [hash_names(some.unique()) for some in drives]
    return np.unique(np.concatenate(found)) if found else np.array([], dtype=np.uint64)


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
        here = manifest.imported_from is None
        if here and manifest.trained_on.grams_version >= without:
            return False
        made = registry.trained_drives(manifest)
        return not bool(np.isin(made.salted, present(name)).all())
    except FleetSlipError:
        return True


def models_trained_on(warehouse: Warehouse, drives: Collection[str]) -> list[str]:
    """Return the model versions that were trained on one of the drives, or may have been."""
    registry = Registry.open(warehouse)
    hashes = hash_names(pa.array(sorted(drives), pa.string()))
    found: list[str] = []
    for name in registry.names():
        for number in registry.versions(name):
            try:
                made = registry.trained_drives(registry.load(name, number).manifest)
                trained = bool(made.among(hashes).any())
            except FleetSlipError:
                trained = True
            if trained:
                found.append(f"{name}@{number}")
    return sorted(found)
