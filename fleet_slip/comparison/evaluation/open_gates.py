"""How far the gates of a model are open on a drive, as the car sees it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.definitions import Definition
from fleet_slip.columns.blocks.column_plan import ColumnPlan
from fleet_slip.columns.blocks.drive_columns import DriveColumns, as_counts
from fleet_slip.models.manifest import Manifest


def gates_of(manifest: Manifest) -> dict[str, tuple[Definition, list[int]]]:
    """Return what opens each gate of a model, and its knots in counts, by what it looks back on."""
    knots: dict[str, tuple[Definition, set[int]]] = {}
    for term in manifest.terms:
        gate = term.definition.gate if term.definition else None
        if gate is not None:
            name = f"{gate.by.of} over {gate.by.ticks} ticks"
            known = knots.setdefault(name, (gate.by, set()))[1]
            known.update(count for count in (gate.low, gate.peak, gate.high) if count is not None)
    return {name: (by, sorted(counts)) for name, (by, counts) in knots.items()}


def gates_on(
    manifest: Manifest, signals: Mapping[str, FloatArray], facts: Mapping[str, Any]
) -> Mapping[str, FloatArray]:
    """Return by gate how far it is open at each tick, shape (ticks,): 0 at the first knot, 1 at
    the last, and equally far from knot to knot."""
    gates = gates_of(manifest)
    if not gates:
        return {}
    names = tuple(f"gate_{number}" for number in range(len(gates)))
    bys = [by for by, _ in gates.values()]
    plan = ColumnPlan.of(names, {}, dict(zip(names, bys, strict=True)))
    columns = DriveColumns(plan, as_counts(signals, plan.signals, facts)).compute()
    return {
        name: np.interp(column, knots, np.linspace(0, 1, len(knots)))
        for (name, (_, knots)), column in zip(gates.items(), columns, strict=True)
    }
