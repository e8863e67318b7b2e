"""What a data root holds."""

import hashlib
from pathlib import Path
from typing import Any

from fleet_slip.models.registry import Registry
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse


def state(root: Path, model: str = "smoke") -> dict[str, Any]:
    """All that a data root holds, apart from the moments at which it was written."""
    warehouse = Warehouse(LocalFolder(root))
    files = {
        path: hashlib.sha256(Path(path).read_bytes()).hexdigest()
        for table in (warehouse.logs, warehouse.grams)
        for path in table.snapshot().paths
    }
    registry = Registry(LocalFolder(root / "models"))
    return {
        "files": {Path(path).relative_to(root): digest for path, digest in files.items()},
        "versions": [registry.load(model, n).sha256 for n in registry.versions(model)],
        "aliases": registry.history(model).aliases(),
        "moves": [(move.command, move.version) for move in registry.history(model).moves()],
    }
