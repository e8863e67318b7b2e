"""Takes names out of log files of earlier versions whose dictionaries have more than their rows.

Such a name may be that of a car that was forgotten since.
"""

from fleet_slip.delta import retry_conflicts
from fleet_slip.maintenance.rewriting import Rewriting, rewrite
from fleet_slip.warehouse.tables import Warehouse


def drop_unused_names(warehouse: Warehouse) -> int:
    """Write log files anew without the names that none of their rows has; return how many.

    It reads the texts of every file. Raises `StorageError`, and `ConflictError` if other processes
    keep changing the same files.
    """

    def attempt() -> int:
        logs = warehouse.logs.snapshot()
        files = [file for file in logs.files if warehouse.logs.has_unused_names(file.path)]
        if files:
            rewritings = [Rewriting("kept", [file]) for file in files]
            rewrite(warehouse, logs, rewritings, note={"job": "names"}, data_change=False)
        return len(files)

    return retry_conflicts(attempt)
