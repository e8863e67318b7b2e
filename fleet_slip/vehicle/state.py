"""What the equations of motion take and give."""

from typing import NamedTuple


class State(NamedTuple):
    """Motion of the car in its own frame, SI units, signs after ISO 8855."""

    vx: float
    vy: float
    yaw_rate: float
    steering_wheel: float
    traction: float
    """Tractive force per mass after the drivetrain's lag; braking where negative."""
    ax_lag: float
    """Longitudinal acceleration as the load transfer has followed it."""
    ay_lag: float
    wheel_fl: float
    wheel_fr: float
    wheel_rl: float
    wheel_rr: float


class Controls(NamedTuple):
    """What the driver asks for."""

    steering_wheel: float
    """Angle in rad."""
    traction: float
    """Force along the car per mass, in m/s²; braking where negative."""
