"""Which model versions were trained on drives that were forgotten.

Who forgets judges the versions that there are. A version that was published meanwhile from Gram
rows that still had the drives was judged by nobody: it counts as trained on them.
"""

from fleet_slip.errors import FleetSlipError
from fleet_slip.files.folder import Folder
from fleet_slip.models.versions import Registry
from fleet_slip.warehouse.audit import Audit


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
    for subject, numbers in judged.items():
        found |= {
            f"{name}@{number}"
            for name, number in versions
            if number > numbers.get(name, 0)
            and _may_have_seen(registry, name, number, without[subject])
        }
    return frozenset(found)


def newest_versions(root: Folder) -> dict[str, int]:
    """Return the number of the newest version of each model."""
    registry = Registry(root / "models")
    return {name: max(registry.versions(name), default=0) for name in registry.names()}


def _may_have_seen(registry: Registry, name: str, number: int, without: int | None) -> bool:
    """Whether a version was made of Gram rows from before a version of them; true if unknown."""
    if without is None:
        return True
    try:
        return registry.load(name, number).manifest.trained_on.grams_version < without
    except FleetSlipError:
        return True
