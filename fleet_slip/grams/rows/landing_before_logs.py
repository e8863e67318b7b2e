"""Lands the Gram rows of log files before the files themselves, where others are written again.

They count while their log file is active: one commit exchanges both.
"""

import json
from collections.abc import Collection, Sequence
from datetime import date

from deltalake.transaction import AddAction

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.delta import Change, Snapshot, TableFile, Unit
from fleet_slip.grams.rows.aggregation import aggregate
from fleet_slip.grams.rows.backlog import named_files, require_active
from fleet_slip.grams.rows.course_delays import course_delays
from fleet_slip.grams.rows.gram_files import write_rows
from fleet_slip.grams.rows.gram_job import unit_name
from fleet_slip.warehouse.tables import Warehouse


def land_ahead(
    warehouse: Warehouse, new: Sequence[AddAction], replaced: Collection[TableFile]
) -> None:
    """Land the Gram rows of new log files, of the feature sets that replaced ones have.

    Raises `ConflictError` if a replaced file is gone, or the Gram rows change at that moment.
    """
    files = [_as_file(action) for action in new]
    for name in (PLAIN, *features().sets):
        identity = features().identity(name)
        grams = warehouse.grams.snapshot()
        done, _ = named_files(grams, identity)
        missing = [file for file in files if file.path not in done]
        if done.isdisjoint(file.path for file in replaced) or not missing:
            continue
        # The logs are looked at last. Whoever removes a file from them fences the Gram rows after
        # it: a commit of Gram rows that has not seen the file go is in conflict.
        logs = Snapshot(warehouse.logs, warehouse.logs.open_delta())  # in whatever scales
        require_active(logs, replaced)
        late = None
        if features().feature_set(name).in_time:
            late = course_delays(grams, frozenset(file.path for file in logs.files))
        rows = aggregate(warehouse, missing, feature_set=name, late=late)
        grams.commit_or_discard(
            Change(
                add=write_rows(warehouse, [rows]),
                units=[Unit(unit_name(identity), logs.version or 0)],
                note={"job": "gram", "feature_set": identity, "logs_version": logs.version},
            )
        )


def _as_file(action: AddAction) -> TableFile:
    stated = json.loads(action.stats)
    day = action.partition_values.get("day")
    return TableFile(
        action.path,
        stated["numRecords"],
        action.size,
        stated["nullCount"],
        date.fromisoformat(day) if day else None,
    )
