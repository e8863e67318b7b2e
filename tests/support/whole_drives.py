"""Simulated drives as a whole, which only tests and benchmarks ask for."""

from collections.abc import Sequence

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.vehicle.batch import STEPS_PER_SAMPLE, LaneDrive, simulate_blocks
from fleet_slip.vehicle.batch_kernel import CHANNELS


class Truth:
    """What happened in one drive, at 100 Hz: float64 arrays of one length by `CHANNELS`."""

    def __init__(self, channels: dict[str, FloatArray], lost_control_tick: int | None) -> None:
        self.channels, self.lost_control_tick = channels, lost_control_tick

    def __getattr__(self, name: str) -> FloatArray:
        return self.channels[name]


def simulate_drives(
    drives: Sequence[LaneDrive], steps_per_sample: int = STEPS_PER_SAMPLE
) -> list[Truth]:
    """Return what happens in each drive as a whole; see `simulate_blocks`."""
    parts: list[list[dict[str, FloatArray]]] = [[] for _ in drives]
    lost: dict[int, int | None] = {}
    for block in simulate_blocks(drives, steps_per_sample):
        parts[block.drive].append({name: x.copy() for name, x in block.channels.items()})
        lost[block.drive] = block.lost_control_tick
    return [
        Truth(
            {name: np.concatenate([part[name] for part in some]) for name in CHANNELS}, lost[drive]
        )
        for drive, some in enumerate(parts)
    ]
