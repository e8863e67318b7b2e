"""Examines drives before a model learns from them: a fault of all shows in no comparison.

A first champion has only its data, and where these are wrong alike, such as a label with the other
sign, no drive is unlike its peers. A label that is late on a new day hardly changes what Gram rows
tell. So a few of the longest drives that are new to the champion, or of all if there is none, are
looked at as a file is at `ingest`: for what contradicts any car.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import RefusedError
from fleet_slip.grams.rows.gram_rows import hash_numbers
from fleet_slip.ingest.drives.measured_drives import SOURCE
from fleet_slip.ingest.drives.suspicion import Suspicion, find_suspicions
from fleet_slip.models.acceptance.champion_rules import find_lacks
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.trained_drives import TrainedDrives
from fleet_slip.warehouse.condition import asking, parse_condition
from fleet_slip.warehouse.table_views import connect_tables
from fleet_slip.warehouse.tables import Warehouse

DRIVES = 5
"""That are looked at, of as many cars if there are so many."""

FEWEST_NEW = 3
"""New drives that are looked at if there is a champion: one alone may be odd."""

MOST_TICKS = 100_000

_LONGEST = """
    SELECT drive_id, day FROM drives WHERE source = $source AND ({condition})
    ORDER BY row_number() OVER (PARTITION BY vehicle_id ORDER BY rows DESC, drive_id),
        rows DESC, drive_id
"""


def require_sound_drives(
    warehouse: Warehouse, manifest: Manifest, made: TrainedDrives | None = None, settled: int = 0
) -> None:
    """Raise `RefusedError` if most of some measured drives of a cohort contradict any car.

    `made` are the drives that made the champion, of `settled` columns: one of more columns needs as
    much data for them as a first champion does. What is looked at is the label, and the signals
    that a model has columns of. Simulated drives, and those of cars that sent no log, are passed
    over.
    """
    found, looked_at, measured = _look(warehouse, manifest, made)
    if measured and len(manifest.terms) > settled and (lacks := find_lacks(manifest)):
        raise RefusedError(
            f"{manifest.name} was not published: {'; '.join(lacks)}. Ingest more drives, choose "
            "fewer columns, or publish it with force all the same."
        )
    if made is not None and looked_at < FEWEST_NEW:
        return
    used = {manifest.label.signal}
    for term in manifest.terms:
        used |= set(term.definition.signals) if term.definition else {term.signal}
    for (_, signals), examples in found.items():
        # Beside a champion, whose drives are in order, half of them are enough.
        if used.isdisjoint(signals) or 2 * len(examples) + (made is not None) <= looked_at:
            continue
        raise RefusedError(
            f"{manifest.name} was not published: {len(examples)} of {looked_at} drives that were "
            f"looked at contradict what any car does: {examples[0]} Publish it with "
            "force all the same, or correct the mapping and run: fleet-slip ingest LOGS --mapping "
            "M --replace"
        )


def _look(
    warehouse: Warehouse, manifest: Manifest, made: TrainedDrives | None
) -> tuple[dict[tuple[str, tuple[str, ...]], list[Suspicion]], int, int]:
    """Return what looks wrong in some long drives, how many these are, and of how many."""
    found: dict[tuple[str, tuple[str, ...]], list[Suspicion]] = {}
    condition = parse_condition(manifest.trained_on.cohort)
    query = _LONGEST.format(condition=condition.sql)
    with connect_tables(warehouse, query + "log_counts") as database, asking(database, condition):
        drives = database.execute(query, {"source": SOURCE}).fetchall()
        measured = len(drives)
        if made is not None:
            numbers = hash_numbers(pa.array([drive for drive, _ in drives], pa.string()))
            seen = made.among(numbers).tolist()
            drives = [drive for drive, known in zip(drives, seen, strict=True) if not known]
        chosen = drives[:DRIVES]
        for drive, day in chosen:
            columns = database.execute(
                "SELECT * FROM log_counts WHERE day = $day AND drive_id = $drive ORDER BY tick "
                f"LIMIT {MOST_TICKS}",
                {"day": day, "drive": drive},
            ).fetchnumpy()
            for suspicion in find_suspicions(_signals(columns)):
                found.setdefault((suspicion.kind, suspicion.signals), []).append(suspicion)
    return found, len(chosen), measured


def _signals(columns: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Return the signals of a drive in SI units on consecutive ticks, NaN where there is none."""
    ticks = np.asarray(columns["tick"], dtype=np.int64)
    found = {}
    for name, signal in catalogue().signals.items():
        if name not in columns:
            continue
        values = np.ma.filled(np.ma.asarray(columns[name], dtype=np.float64), np.nan)
        if np.isfinite(values).any():
            dense = np.full(int(ticks[-1] - ticks[0]) + 1, np.nan)
            dense[ticks - ticks[0]] = values * float(signal.scale)
            found[name] = dense
    return found
