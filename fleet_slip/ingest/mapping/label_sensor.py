"""Where the sensor of the label is, against the centre of gravity."""

from collections.abc import Container

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.config import Config
from fleet_slip.ingest.mapping.signal_column import WHEELS, Place

SPEEDS = ("vx", "vehicle_speed")


class LabelSensor(Config):
    """The sensor that tells side-slip: its place, and whether it tells velocities or the angle.

    A car that turns drives sideways before and behind its centre of gravity, so that an optical
    sensor on the rear bumper tells another angle.
    """

    from_velocities: bool = False
    """Side-slip is arctan(vy / vx), of the signals `vx` and `vy`, which are the sensor's."""
    sensor_x_m: Place = 0.0
    """How far the sensor is before the centre of gravity."""
    sensor_y_m: Place = 0.0
    """How far it is to the left of the centre of gravity."""

    @property
    def is_elsewhere(self) -> bool:
        """Whether it is not at the centre of gravity."""
        return bool(self.sensor_x_m or self.sensor_y_m)

    def require_signals(self, signals: Container[str]) -> None:
        """Raise `ValueError` for a mapping that lacks what the label is computed from."""
        label = catalogue().label
        if self.from_velocities and label in signals:
            raise ValueError(f"label: from_velocities, and {label} has a column: leave out one")
        needed = ["vx", "vy"] if self.from_velocities else [label]
        needed += ["yaw_rate"] if self.is_elsewhere else []
        for name in needed:
            if name not in signals:
                raise ValueError(f"label: it needs the signal {name}")
        wheels = all(f"{WHEELS}{corner}" in signals for corner in ("fl", "fr", "rl", "rr"))
        if self.is_elsewhere and not wheels and not any(name in signals for name in SPEEDS):
            raise ValueError("label: to move it needs a speed: vx, vehicle_speed or four wheels")
