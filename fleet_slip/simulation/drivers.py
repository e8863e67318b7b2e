"""Drivers who differ: the line that each takes along a road of a class, and how fast."""

import numpy as np

from fleet_slip.config import Config
from fleet_slip.simulation.imperfections import Range, Uniform
from fleet_slip.simulation.roads import CLASSES, WANDER_S, driven_line
from fleet_slip.simulation.track import SpeedLimits, Track
from fleet_slip.vehicle.parameters import GRAVITY_MPS2


class Drivers(Config):
    """How drivers differ: the line, how they wander about it, and their temper."""

    cut: Range
    """How far ahead and behind a bend is rounded off, over the smallest radius of the class."""
    wander_m: Range
    acceleration_mps2: Uniform
    """On a road with μ = 1; less on others."""
    braking_mps2: Uniform
    top_speed: Uniform
    """Over that of the road's class."""

    def line(self, road: Track, kind: str, of_drive: np.random.Generator) -> Track:
        """Draw the line that a driver takes along a road of a class."""
        cut_m = self.cut.draw(of_drive) * CLASSES[kind].radius_m[0]
        every_m = WANDER_S * CLASSES[kind].top_speed_mps
        return driven_line(road, cut_m, self.wander_m.draw(of_drive), every_m, of_drive)

    def limits(
        self, kind: str, adhesion: float, friction_use: float, of_drive: np.random.Generator
    ) -> SpeedLimits:
        """Draw how fast a driver goes who sees the adhesion."""
        return SpeedLimits(
            lateral_mps2=friction_use * adhesion * GRAVITY_MPS2,
            acceleration_mps2=self.acceleration_mps2.draw(of_drive) * adhesion,
            braking_mps2=self.braking_mps2.draw(of_drive) * adhesion,
            top_speed_mps=self.top_speed.draw(of_drive) * CLASSES[kind].top_speed_mps,
        )
