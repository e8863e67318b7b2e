"""Which model versions were trained on drives that were forgotten.

Who forgets judges the versions that there are. A version that was published meanwhile was judged by
nobody. Made of Gram rows from before they were without the drives, it counts as trained on them
until the erasure is done; then it does if one of its own drives (`models/trained_drives.py`) has no
Gram rows any more. A version from before those were kept counts as trained on them for ever.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from fleet_slip.errors import FleetSlipError
from fleet_slip.files.folder import Folder
from fleet_slip.grams.rows.rollup import Hashes, hash_numbers
from fleet_slip.models.trained_drives import hash_drives, read_trained_drives
from fleet_slip.models.versions import Registry
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.tables import Warehouse


def marked_models(root: Folder) -> frozenset[str]:
    """Return the model versions, NAME@VERSION, that were or may have been trained on them."""
    entries = Audit(root).entries()
    found = {name for entry in entries for name in entry.get("models", ())}
    judged: dict[str, dict[str, int]] = {}
    without: dict[str, int | None] = {}
    for entry in entries:
        if entry["event"] == "begun" and "judged" in entry:
            judged[entry["subject"]] = entry["judged"]
            without[entry["subject"]] = None
        elif entry["event"] == "done":
            without[entry["subject"]] = entry.get("grams_version")
    registry = Registry(root / "models")
    versions = [(n, number) for n in registry.names() if judged for number in registry.versions(n)]
    drives = _PresentDrives(Warehouse(root))
    for subject, numbers in judged.items():
        found |= {
            f"{name}@{number}"
            for name, number in versions
            if number > numbers.get(name, 0)
            and _may_have_seen(registry, name, number, without[subject], drives)
        }
    return frozenset(found)


def newest_versions(root: Folder) -> dict[str, int]:
    """Return the number of the newest version of each model."""
    registry = Registry(root / "models")
    return {name: max(registry.versions(name), default=0) for name in registry.names()}


@dataclass(frozen=True)
class _PresentDrives:
    """The drives that have Gram rows, read when they are asked for."""

    warehouse: Warehouse
    hashed: dict[str, Hashes] = field(default_factory=dict)

    def hashed_for(self, name: str) -> Hashes:
        """Return them as the versions of a model keep them."""
        if name not in self.hashed:
            self.hashed[name] = hash_drives(name, self._hashes)
        return self.hashed[name]

    @cached_property
    def _hashes(self) -> Hashes:
        grams = self.warehouse.grams.snapshot()
        drives = (grams.table.read(file.path, ["drive_id"])["drive_id"] for file in grams.files)
        found = [hash_numbers(some.unique()) for some in drives]
        return np.unique(np.concatenate(found)) if found else np.array([], dtype=np.uint64)


def _may_have_seen(
    registry: Registry, name: str, number: int, without: int | None, present: _PresentDrives
) -> bool:
    """Whether a version was trained on drives that Gram rows are without since a version of them.

    True if that cannot be told.
    """
    if without is None:
        return True
    try:
        manifest = registry.load(name, number).manifest
        here = manifest.imported_from is None
        if here and manifest.trained_on.grams_version >= without:
            return False
        kept = read_trained_drives(registry.folder_of(name), manifest)
        return kept is None or not bool(np.isin(kept, present.hashed_for(name)).all())
    except FleetSlipError:
        return True
