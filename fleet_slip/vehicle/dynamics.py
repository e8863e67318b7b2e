"""Equations of motion of a planar car on four wheels.

The road may slope, its adhesion may vary and wind may blow. Steering may yield, wheels may differ
and tyres may lag. The textbook's car is the special case without imperfections.
Symbols, sources and limits are in `docs/vehicle.md`; imperfections are in `docs/simulator.md`.
"""

import math
from typing import Generic, NamedTuple, TypeVar

from fleet_slip.compiling import equation
from fleet_slip.vehicle.parameters import Constants, Controls, ImperfectionConstants, State

# The brush tyre with combined slip: bristles stick to the road over a part of the contact patch and
# slide over the remainder. The model and its derivation are in `docs/vehicle.md`.
#
# H. B. Pacejka, "Tire and Vehicle Dynamics", 3rd ed. (2012), section 3.3, equations 4.E25
# (cornering stiffness over load) and 4.E7 (friction over sliding speed).
# J. Svendenius, "Tire Modeling and Friction Estimation" (Lund, 2007): sticking and sliding parts.

CREEP_SPEED_MPS = 2.5
"""Lower bound of the rolling speed that slip is divided by, in m/s, so that a car comes to rest.

Stable where C h / (m v) < 1/4, with C the slip stiffness of all wheels, h the time step, m the
mass and v this speed. `MAX_STIFFNESS_PER_LOAD` limits C.
"""

MIN_SLIDING_MPS = 1e-9
"""Lower bound of the sliding speed in m/s: the direction of sliding stays finite at rest."""


class TyreForce(NamedTuple):
    """Force of the road on the tyre in the wheel's frame."""

    x: float
    """Along the wheel, in N."""
    y: float
    """Across the wheel to the left, in N."""
    damping: float
    """Approximately −∂x/∂(longitudinal velocity), in N s/m: how the tyre damps the wheel's spin."""
    slip: float
    """Longitudinal slip σx, positive when driven."""
    slip_per_speed: float
    """∂σx/∂(rolling speed), in s/m."""


@equation
def cornering_stiffness(load: float, peak: float, c: Constants) -> float:
    """Compute the cornering stiffness c1·sin(2·arctan(Fz/c2)), without the sine.

    Parameters
    ----------
    load
        Vertical load Fz, in N.
    peak
        Largest cornering stiffness c1, in N per unit of slip.
    c
        Constants of the car.

    Returns
    -------
    float
        Cornering stiffness, in N per unit of slip.

    References
    ----------
    Pacejka (2012), equation 4.E25.
    """
    x = load * c.inverse_stiffness_load
    return peak * 2.0 * x / (1.0 + x * x)


@equation
def brush_force(
    along: float,
    across: float,
    rolling: float,
    load: float,
    peak: float,
    c: Constants,
    grip: float = 1.0,
) -> TyreForce:
    """Compute the force of a brush tyre.

    With slip stiffnesses Cx and Cy, slip σ = v_s / |rolling| and μ(v_s) = μ0 / (1 + |v_s| / V),
    bristles stick over a part λ of the contact patch::

        λ = max(0, 1 − |(Cx σx, Cy σy)| / (3 μ0 Fz))
        F = λ² (Cx σx, Cy σy) + (1 − λ)² (1 + 2 λ) μ(v_s) Fz v_s / |v_s|, v_s against the sliding.

    Parameters
    ----------
    along, across
        Velocity of the wheel's centre in the wheel's frame, in m/s.
    rolling
        Spin times rolling radius, in m/s.
    load
        Vertical load, positive, in N.
    peak
        Largest cornering stiffness, in N per unit of slip.
    c
        Constants of the car.
    grip
        Adhesion at this wheel over the adhesion of the drive.

    Returns
    -------
    TyreForce
        Force of the road on the tyre.
    """
    slide_x = rolling - along
    slide_y = -across
    limit = (c.friction - c.friction_per_load * load) * load * grip
    # One division serves three quotients: 1 / speed, Cy = 2 c1 x / (1 + x²), and 1 / (3 limit).
    speed = max(abs(rolling), CREEP_SPEED_MPS)
    x = load * c.inverse_stiffness_load
    steep = 1.0 + x * x
    triple = 3.0 * limit
    inverse = 1.0 / (speed * steep * triple)
    per_speed = inverse * steep * triple
    bristle_y = inverse * triple * peak * 2.0 * x
    bristle_x = c.stiffness_ratio * bristle_y
    stuck_x = bristle_x * slide_x
    stuck_y = bristle_y * slide_y
    used = math.sqrt(stuck_x * stuck_x + stuck_y * stuck_y) * (inverse * steep * speed)
    stuck = max(0.0, 1.0 - used)
    stuck2 = stuck * stuck
    loose = (1.0 - stuck) * (1.0 - stuck) * (1.0 + 2.0 * stuck)
    sliding = max(math.sqrt(slide_x * slide_x + slide_y * slide_y), MIN_SLIDING_MPS)
    decay = 1.0 + sliding * c.inverse_decay_speed
    decayed = 1.0 / (sliding * decay)
    drag = limit * loose * decayed
    direction_y = slide_y * decayed * decay
    return TyreForce(
        stuck2 * stuck_x + drag * slide_x,
        stuck2 * stuck_y + drag * slide_y,
        stuck2 * bristle_x + drag * direction_y * direction_y,
        slide_x * per_speed,
        per_speed,
    )


TAN_PI_8 = math.sqrt(2.0) - 1.0
MIN_DENOMINATOR = 1e-300
"""Keeps the quotient of the null vector finite."""

A0 = 0.99999999999927092
A1 = -0.3333333327838281
A2 = 0.19999993188756549
A3 = -0.14285391255132365
A4 = 0.11103534845215567
A5 = -0.089932166610089848
A6 = 0.069770025182929116
A7 = -0.037701690770728893
"""Near-minimax fit of arctan(q)/q over q², |q| ≤ tan(π/8), at Chebyshev nodes; error 3e-13."""


@equation
def arctan2(y: float, x: float) -> float:
    """Compute the angle of a vector, with the same bits on every machine.

    C libraries differ in the last bit of `atan2`. This one uses additions, multiplications and one
    division. Its error is below 1e-12 rad, far less than one count.

    Parameters
    ----------
    y, x
        Components of the vector.

    Returns
    -------
    float
        Angle in rad, in [−π, π]; 0 for the null vector.
    """
    small, large = min(abs(x), abs(y)), max(abs(x), abs(y))
    rotated = small > TAN_PI_8 * large
    numerator = small - large if rotated else small
    denominator = small + large if rotated else large
    q = numerator / max(denominator, MIN_DENOMINATOR)
    z = q * q
    series = A0 + z * (A1 + z * (A2 + z * (A3 + z * (A4 + z * (A5 + z * (A6 + z * A7))))))
    octant = q * series + (math.pi / 4 if rotated else 0.0)
    quadrant = math.pi / 2 - octant if abs(y) > abs(x) else octant
    half = math.pi - quadrant if x < 0.0 else quadrant
    return -half if y < 0.0 else half


# The car on its wheels.

MIN_LOAD_N = 1.0
"""Load of a lifted wheel, in N: it transmits no force, and no division by zero occurs."""

STICTION_RAD_S = 0.1
"""Wheel speed below which brakes and rolling resistance fade, so that a wheel comes to rest."""

MIN_DRIVE_SPEED_MPS = 1.0
"""Lower bound of the speed that the engine's power is divided by, in m/s."""

T = TypeVar("T")


class Wheels(NamedTuple, Generic[T]):
    """One value for each wheel: front left, front right, rear left, rear right."""

    fl: T
    fr: T
    rl: T
    rr: T


class Environment(NamedTuple):
    """Road and air at the car, and the temperature of its tyres."""

    gravity_x: float
    """Component of gravity along the road, in m/s²; negative uphill."""
    gravity_y: float
    """Component of gravity across the road to the left, in m/s²."""
    grip_left: float
    """Adhesion under the left wheels over the adhesion of the drive."""
    grip_right: float
    """Adhesion under the right wheels over the adhesion of the drive."""
    wind: float
    """Speed of the air across the car to the left, in m/s."""
    stiffness: float
    """Cornering stiffness over that of warm tyres."""


CALM = Environment(0.0, 0.0, 1.0, 1.0, 0.0, 1.0)
"""A flat, even and calm road, and warm tyres."""


class Compliance(NamedTuple):
    """Elastic states of steering and tyres, which follow the car with a lag."""

    rack: float
    """Position of the steering rack, as an angle of the steering wheel in rad."""
    rack_force: float
    """Lateral force of the front axle that the steering has yielded to, in N."""
    side_fl: float
    """Lateral velocity of a wheel that its tyre has relaxed to, in m/s."""
    side_fr: float
    side_rl: float
    side_rr: float


class ComplianceRates(NamedTuple):
    """Rates of `Compliance`. The rack has none: its play is taken up at once."""

    rack_force: float
    side_fl: float
    side_fr: float
    side_rl: float
    side_rr: float


class WheelForce(NamedTuple):
    """Force of one wheel on the car in the car's frame, in N, and its reaction on the wheel."""

    x: float
    y: float
    along: float
    """Component along the wheel, in N."""
    damping: float
    """Damping of the wheel's spin by the tyre, in N s/m."""
    slip: float
    slip_per_speed: float


class WheelRate(NamedTuple):
    """Rate of one wheel's speed ω."""

    rate: float
    """dω/dt in rad/s²."""
    stiffness: float
    """Upper bound of −∂(dω/dt)/∂ω, in 1/s."""


class Acceleration(NamedTuple):
    """Specific force at the centre of gravity, and the rates of the body's motion."""

    ax: float
    ay: float
    vx: float
    vy: float
    yaw_rate: float


class Direction(NamedTuple):
    """Unit vector of a wheel's steering angle."""

    cosine: float
    sine: float


class Derivative(NamedTuple):
    """Rates of the state, and the specific force at the centre of gravity."""

    vx: float
    vy: float
    yaw_rate: float
    steering_wheel: float
    traction: float
    ax_lag: float
    ay_lag: float
    wheel_fl: WheelRate
    wheel_fr: WheelRate
    wheel_rl: WheelRate
    wheel_rr: WheelRate
    ax: float
    """Longitudinal specific force v̇x − r vy, in m/s²."""
    ay: float
    """Lateral specific force v̇y + r vx, in m/s²."""


@equation
def direction_of(along: float, across: float) -> Direction:
    """Normalise a vector with `along` > 0."""
    inverse = 1.0 / math.sqrt(along * along + across * across)
    return Direction(along * inverse, across * inverse)


@equation
def front_wheels(
    compliance: Compliance, c: Constants, t: ImperfectionConstants
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Compute the directions of the front wheels.

    The tangent of a wheel's angle is t / (1 ∓ t w / (2 L)). Here t is the tangent of the rack's
    angle over the steering ratio, less the compliance; w is the track width and L the wheelbase.
    Without toe, both wheels point at right angles to one centre of the turn (Ackermann).

    Parameters
    ----------
    compliance
        State of the steering.
    c, t
        Constants of the car and of its imperfections.

    Returns
    -------
    tuple
        Vectors (along, across) of the left and of the right wheel, not normalised.
    """
    tangent = c.steer_per_wheel * compliance.rack - t.steering_compliance * compliance.rack_force
    nearer = c.ackermann * tangent
    left_along, right_along = 1.0 - nearer, 1.0 + nearer
    return (
        (left_along + t.toe * tangent, tangent - t.toe * left_along),
        (right_along - t.toe * tangent, tangent + t.toe * right_along),
    )


@equation
def transferred_loads(x: State, c: Constants) -> Wheels[float]:
    """Compute the vertical loads of the wheels under the lagged accelerations, in N.

    A car pitches backwards when it accelerates, and rolls outwards in a turn.
    """
    pitch = c.pitch_transfer * x.ax_lag
    roll_front = c.roll_transfer_front * x.ay_lag
    roll_rear = c.roll_transfer_rear * x.ay_lag
    return Wheels(
        max(c.static_front - pitch - roll_front, MIN_LOAD_N),
        max(c.static_front - pitch + roll_front, MIN_LOAD_N),
        max(c.static_rear + pitch - roll_rear, MIN_LOAD_N),
        max(c.static_rear + pitch + roll_rear, MIN_LOAD_N),
    )


@equation
def _wheel_force(
    vx: float,
    vy: float,
    relaxed_side: float,
    direction: Direction,
    rolling: float,
    load: float,
    peak: float,
    grip: float,
    c: Constants,
    t: ImperfectionConstants,
) -> tuple[WheelForce, float]:
    """Compute the force of a wheel, and the rate of its tyre's relaxation (Pacejka 2012, 7.2)."""
    cosine, sine = direction
    along = cosine * vx + sine * vy
    across = cosine * vy - sine * vx
    relaxed = across + t.relaxes * (relaxed_side - across)
    force = brush_force(along, relaxed, rolling, load, peak, c, grip)
    speed = max(abs(rolling), CREEP_SPEED_MPS)
    in_car_frame = WheelForce(
        cosine * force.x - sine * force.y,
        sine * force.x + cosine * force.y,
        force.x,
        force.damping,
        force.slip,
        force.slip_per_speed,
    )
    return in_car_frame, speed * t.inverse_relaxation * (across - relaxed_side)


@equation
def wheel_forces(
    x: State,
    compliance: Compliance,
    environment: Environment,
    load: Wheels[float],
    c: Constants,
    t: ImperfectionConstants,
) -> tuple[Wheels[WheelForce], ComplianceRates]:
    """Compute the forces of the wheels and the rates of compliance.

    Parameters
    ----------
    x
        State of the car.
    compliance
        Elastic states of steering and tyres.
    environment
        Road and air at the car.
    load
        Vertical loads of the wheels, in N.
    c, t
        Constants of the car and of its imperfections.

    Returns
    -------
    Wheels[WheelForce]
        Forces in the car's frame, in N.
    ComplianceRates
        Rates of the elastic states.
    """
    vector_l, vector_r = front_wheels(compliance, c, t)
    front_l, front_r = direction_of(*vector_l), direction_of(*vector_r)
    rear_l, rear_r = direction_of(1.0, t.rear_left), direction_of(1.0, t.rear_right)
    front, rear = x.vy + c.front * x.yaw_rate, x.vy - c.rear * x.yaw_rate
    turn_f, turn_r = c.half_track_width_front * x.yaw_rate, c.half_track_width_rear * x.yaw_rate
    peak_f = environment.stiffness * c.stiffness_front
    peak_r = environment.stiffness * c.stiffness_rear
    roll_fl = (t.radius_fl - t.radius_loss * (load.fl - c.static_front)) * x.wheel_fl
    roll_fr = (t.radius_fr - t.radius_loss * (load.fr - c.static_front)) * x.wheel_fr
    roll_rl = (t.radius_rl - t.radius_loss * (load.rl - c.static_rear)) * x.wheel_rl
    roll_rr = (t.radius_rr - t.radius_loss * (load.rr - c.static_rear)) * x.wheel_rr
    grip_l, grip_r = environment.grip_left, environment.grip_right
    fl, side_fl = _wheel_force(
        x.vx - turn_f, front, compliance.side_fl, front_l, roll_fl, load.fl, peak_f, grip_l, c, t
    )
    fr, side_fr = _wheel_force(
        x.vx + turn_f, front, compliance.side_fr, front_r, roll_fr, load.fr, peak_f, grip_r, c, t
    )
    rl, side_rl = _wheel_force(
        x.vx - turn_r, rear, compliance.side_rl, rear_l, roll_rl, load.rl, peak_r, grip_l, c, t
    )
    rr, side_rr = _wheel_force(
        x.vx + turn_r, rear, compliance.side_rr, rear_r, roll_rr, load.rr, peak_r, grip_r, c, t
    )
    yielding = (fl.y + fr.y - compliance.rack_force) * c.inverse_steering_lag
    return Wheels(fl, fr, rl, rr), ComplianceRates(yielding, side_fl, side_fr, side_rl, side_rr)


@equation
def spin_rate(
    force: WheelForce, spin: float, load: float, drive: float, brake: float, c: Constants
) -> WheelRate:
    """Compute the rate of a wheel's speed, I dω/dt = Σ torques.

    Brake and rolling resistance fade below `STICTION_RAD_S`. Slip control reduces the torque to
    zero as slip grows from `slip_control` to three times that.

    Parameters
    ----------
    force
        Force of the wheel.
    spin
        Speed of the wheel ω, in rad/s.
    load, drive, brake
        Vertical load, drive force and brake force at the rim, in N.
    c
        Constants of the car.

    Returns
    -------
    WheelRate
        dω/dt, and a bound of its derivative by ω for implicit steps.
    """
    passed = min(max(1.5 - abs(force.slip) * c.inverse_slip_band, 0.0), 1.0)
    fading = c.inverse_slip_band * force.slip_per_speed if 0.0 < passed < 1.0 else 0.0
    friction = (passed * brake + c.rolling_resistance * load) / max(abs(spin), STICTION_RAD_S)
    gain = c.radius * c.inverse_spin_inertia
    damping = force.damping + fading * (drive + brake)
    return WheelRate(
        gain * (passed * drive - force.along - friction * spin),
        gain * (c.radius * damping + friction),
    )


@equation
def spin_rates(
    x: State, force: Wheels[WheelForce], load: Wheels[float], c: Constants
) -> Wheels[WheelRate]:
    """Compute the rates of the wheels under the drivetrain's torque and the brakes."""
    max_drive = c.power_per_mass / max(abs(x.vx), MIN_DRIVE_SPEED_MPS)
    drive = c.mass * min(max(x.traction, 0.0), max_drive)
    drive_f, drive_r = c.drive_front * drive, c.drive_rear * drive
    brake = c.mass * max(-x.traction, 0.0)
    brake_f, brake_r = c.brake_front * brake, c.brake_rear * brake
    return Wheels(
        spin_rate(force.fl, x.wheel_fl, load.fl, drive_f, brake_f, c),
        spin_rate(force.fr, x.wheel_fr, load.fr, drive_f, brake_f, c),
        spin_rate(force.rl, x.wheel_rl, load.rl, drive_r, brake_r, c),
        spin_rate(force.rr, x.wheel_rr, load.rr, drive_r, brake_r, c),
    )


@equation
def body_acceleration(x: State, force: Wheels[WheelForce], c: Constants) -> Acceleration:
    """Compute the motion of the body by Newton and Euler: m (v̇ + ω × v) = ΣF, I ṙ = ΣM.

    Parameters
    ----------
    x
        State of the car.
    force
        Forces of the wheels in the car's frame, in N.
    c
        Constants of the car.

    Returns
    -------
    Acceleration
        Specific force in m/s², and the rates of vx, vy and yaw rate.
    """
    air = c.drag_per_mass * abs(x.vx) * x.vx
    x_front, x_rear = force.fl.x + force.fr.x, force.rl.x + force.rr.x
    ax = (x_front + x_rear) * c.inverse_mass - air
    y_front, y_rear = force.fl.y + force.fr.y, force.rl.y + force.rr.y
    ay = (y_front + y_rear) * c.inverse_mass
    moment = (
        c.front * y_front
        - c.rear * y_rear
        + c.half_track_width_front * (force.fr.x - force.fl.x)
        + c.half_track_width_rear * (force.rr.x - force.rl.x)
    )
    return Acceleration(
        ax, ay, ax + x.yaw_rate * x.vy, ay - x.yaw_rate * x.vx, moment * c.inverse_yaw_inertia
    )


@equation
def imperfect_derivative(
    x: State,
    u: Controls,
    compliance: Compliance,
    environment: Environment,
    c: Constants,
    t: ImperfectionConstants,
) -> tuple[Derivative, ComplianceRates]:
    """Compute the rates of the whole state: the equations of motion, a pure function.

    Gravity on a slope accelerates the car but not the accelerometer's mass against it, so that it
    is not part of the specific force; wind is.

    Parameters
    ----------
    x
        State of the car.
    u
        Demands of the driver.
    compliance
        Elastic states of steering and tyres.
    environment
        Road and air at the car.
    c, t
        Constants of the car and of its imperfections.

    Returns
    -------
    Derivative
        Rates of the state, and the specific force.
    ComplianceRates
        Rates of the elastic states.

    References
    ----------
    R. Rajamani, "Vehicle Dynamics and Control" (2012); Milliken and Milliken, "Race Car Vehicle
    Dynamics" (1995), chapter 18 (load transfer); Pacejka (2012) (tyres).
    """
    load = transferred_loads(x, c)
    force, compliance_rates = wheel_forces(x, compliance, environment, load, c, t)
    calm = body_acceleration(x, force, c)
    spin = spin_rates(x, force, load, c)
    push = x.vx * environment.wind
    ay = calm.ay + t.wind_force * push
    rates = Derivative(
        calm.vx + environment.gravity_x,
        calm.vy + t.wind_force * push + environment.gravity_y,
        calm.yaw_rate + t.wind_moment * push,
        (u.steering_wheel - x.steering_wheel) * c.inverse_steering_lag,
        (u.traction - x.traction) * c.inverse_drive_lag,
        (calm.ax - x.ax_lag) * c.inverse_pitch_lag,
        (ay - x.ay_lag) * c.inverse_roll_lag,
        spin.fl,
        spin.fr,
        spin.rl,
        spin.rr,
        calm.ax,
        ay,
    )
    return rates, compliance_rates
