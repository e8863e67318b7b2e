"""Lowers a Kalman filter to integer steps: states in 2⁻¹⁶, covariances in 2⁻³², SI units.

The filter is that of `fleet_slip.evaluation.ekf`, with its yaw rate filter: state [vx, vy, r, b],
tyres by Fiala under the current loads. Every operation rounds once. Every number is clipped where
its operands do not bound it, so that `Lowering.ranges` proves that nothing overflows.

A tick without any input changes nothing. A missing measurement does not correct the state, and
missing inputs keep their value. The filter starts at the first tick that has all inputs. It starts
again where its velocity differs from the wheels' by more than `RESTART_MPS`, or a bias is at its
limit, so that no fault of a sensor outlasts its end.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from itertools import combinations_with_replacement, pairwise
from typing import TYPE_CHECKING, NamedTuple

from fleet_slip.catalog.definitions import Blend, Observer, ObserverInput

if TYPE_CHECKING:
    from fleet_slip.columns.lowering import Lowering

STATE, COVARIANCE, RATIO, GAIN, TRANSITION = 16, 32, 20, 22, 24
"""Bits of the fraction: of states, of covariances, of sines and slips, of gains, and of F."""

STEP_S = 0.01
GRAVITY_MPS2 = 9.80665

VX_MPS, VY_MPS, YAW_RAD_S, ACCELERATION_MPS2 = 128.0, 64.0, 8.0, 64.0
"""Limits of states and inputs."""

BIAS_MPS2, GYRO_BIAS_RAD_S = 2.0, 0.1
"""Limits of the biases of accelerometer and gyroscope: beyond them the filter starts again."""

STEER_RAD = 1.0
VARIANCE = 4.0
"""Limit of a covariance, in SI units."""

DERIVATIVE = 127.0
"""Limit of the derivatives of accelerations by velocities, in 1/s."""

STIFFNESS_MPS2, GRIP_MPS2 = 1023.0, 127.0
"""Limits of an axle's stiffness per slip and of its grip, over the mass."""

SLOWEST_MPS, SLOWEST_ANGLE_MPS = 5.0, 1.0
"""Speeds below which slip, and the angle, are measured against these speeds."""

BRAKING_MPS2 = -0.5
"""Acceleration below which wheels give no yaw rate."""

RESTART_MPS = 10.0
LAG_SHARE = 0.1
"""Share of a new value in the acceleration from wheel speeds, where ax is not logged."""

LEAST_LOAD = 0.05
INITIAL_VARIANCES = (1.0, 1.0, 0.01)
INITIAL_YAW_VARIANCE = 1.0

ARCTAN = (
    0.99999999999927,
    -0.33333333278,
    0.19999993189,
    -0.14285391255,
    0.11103534846,
    -0.0899321,
)
"""Coefficients of arctan(q)/q over q² for q up to tan(π/8); the error is below 2⁻²⁰."""

TAN_PI_8 = math.sqrt(2.0) - 1.0
ANGLE_RAD = 1.75
"""Limit of the angle, above π/2."""

SHARE_BITS, WEIGHT_BITS = 16, 10
"""Bits of the fraction of shares, and of weights between knots."""


@dataclass(frozen=True)
class Number:
    """A step that holds value · 2^bits, rounded."""

    low: "Lowering"
    step: int
    bits: int

    def do(self, operation: str, *operands: "Number | int") -> "Number":
        """Return the result of an operation that keeps the bits."""
        steps = [other.step if isinstance(other, Number) else other for other in operands]
        return Number(self.low, self.low.do(operation, self.step, *steps), self.bits)

    def like(self, value: "Number | float") -> "Number":
        """Return a constant with the same bits; return a number unchanged."""
        if isinstance(value, Number):
            if value.bits != self.bits:
                raise ValueError(f"{value.bits} and {self.bits} bits")
            return value
        return Number(self.low, self.low.constant(round(value * 2**self.bits)), self.bits)

    def __add__(self, other: "Number | float") -> "Number":
        return self.do("+", self.like(other))

    def __sub__(self, other: "Number | float") -> "Number":
        return self.do("-", self.like(other))

    def __neg__(self) -> "Number":
        return self.do("negative")

    def __abs__(self) -> "Number":
        return self.do("abs")

    def __mul__(self, other: "Number") -> "Number":
        return Number(self.low, self.low.do("*", self.step, other.step), self.bits + other.bits)

    def to(self, bits: int) -> "Number":
        """Round to fewer bits; more bits are exact."""
        if bits == self.bits:
            return self
        if bits < self.bits:
            return Number(self.low, self.low.do("shift", self.step, self.bits - bits), bits)
        factor = self.low.constant(2 ** (bits - self.bits))
        return Number(self.low, self.low.do("*", self.step, factor), bits)

    def times(self, factor: float, bits: int | None = None) -> "Number":
        """Multiply by a constant of 20 significant bits, or 2⁻⁴⁰, and round once."""
        exponent = min(20 - math.frexp(factor)[1], 40)
        constant = Number(self.low, self.low.constant(round(factor * 2.0**exponent)), exponent)
        return (self * constant).to(self.bits if bits is None else bits)

    def over(self, divisor: "Number", bits: int) -> "Number":
        """Divide by a positive number and round once."""
        numerator = self.to(bits + divisor.bits)
        return Number(self.low, self.low.do("nearest", numerator.step, divisor.step), bits)

    def within(self, limit: float) -> "Number":
        """Clip to ±limit."""
        return Number(self.low, self.low.clip(self.step, round(limit * 2**self.bits)), self.bits)

    def at_least(self, value: "Number | float") -> "Number":
        """Return the larger of both."""
        return self.do("max", self.like(value))

    def at_most(self, value: "Number | float") -> "Number":
        """Return the smaller of both."""
        return self.do("min", self.like(value))

    def present(self) -> "Number":
        """Return 1 with no bits where there is a value, else 0."""
        unit, zero = self.low.constant(1), self.low.constant(0)
        return Number(self.low, self.low.do("else", self.low.do("where", unit, self.step), zero), 0)

    def exceeds(self, value: "Number | float") -> "Number":
        """Return 1 with no bits where this is larger, else 0."""
        sign = (self - value).do("sign")
        return Number(self.low, sign.step, 0).at_least(0)

    def orelse(self, other: "Number | float") -> "Number":
        """Return the other number where this is missing."""
        return self.do("else", self.like(other))

    def where(self, condition: "Number") -> "Number":
        """Return the number where a condition is 1; missing elsewhere."""
        limit = self.low.constant(1)
        return self.do("where", self.low.do("at_least", condition.step, limit))


def choose(condition: Number, first: Number, second: Number) -> Number:
    """Return the first number where a condition is 1, else the second."""
    return first.where(condition).orelse(second)


class ObserverLowering:
    """Writes the steps of one tick of an observer."""

    def __init__(self, low: "Lowering", observer: Observer) -> None:
        self.low, self.observer, self.car = low, observer, observer.car
        self._next: list[tuple[Number, Number]] = []

    def angle(self) -> int:
        """Return the step of the angle in counts of 2⁻¹⁶ rad."""
        car = self.car
        logged = self._inputs()
        started = self._state(1.0, 0)
        velocity = [self._state(limit) for limit in (VX_MPS, VY_MPS, YAW_RAD_S, BIAS_MPS2)]
        held = {name: self._state(_LIMITS[name]) for name in logged if name != "wheels"}
        counts = [logged[name].present() for name in held]
        arrives = reduce(Number.at_least, counts)
        speed = logged["speed"].orelse(held["speed"])
        gyro_bias = self._state(GYRO_BIAS_RAD_S)
        strays = (
            abs(speed - velocity[0])
            .exceeds(RESTART_MPS)
            .at_least(abs(velocity[3]).exceeds(BIAS_MPS2 - 2.0**-STATE))
            .at_least(abs(gyro_bias).exceeds(GYRO_BIAS_RAD_S - 2.0 ** (1 - STATE)))
        )
        begins = reduce(Number.at_most, counts).at_most(
            strays.at_least(started.like(1.0) - started)
        )
        now = {name: logged[name].orelse(held[name]) for name in held}
        acceleration = now["ax"] if "ax" in now else self._ax_from(speed, held["speed"], begins)
        steer = now["steer"].to(RATIO)
        square = (steer * steer).to(RATIO)
        sine = (steer * _series(square, (1, -1 / 6, 1 / 120, -1 / 5040))).to(RATIO)
        cosine = _series(square, (1, -1 / 2, 1 / 24, -1 / 720, 1 / 40320)).at_least(0.5)
        rate = self._yaw_rate(logged, gyro_bias, acceleration, cosine, begins)
        if self.observer.axle == "front":
            turned = (sine * rate.times(car.front_axle_m)).to(STATE)
            speed = (speed - turned).over(cosine, STATE).within(VX_MPS)
        road = WheelsOnRoad(sine, cosine, *self._axles(acceleration, now["ay"], begins))

        initial = [speed, rate.times(car.rear_axle_m).within(VY_MPS), rate, rate.like(0.0)]
        variances = (*INITIAL_VARIANCES, min(car.ay_bias_std_mps2**2, VARIANCE))
        pairs = list(combinations_with_replacement(range(4), 2))
        stored = {pair: self._state(VARIANCE, COVARIANCE) for pair in pairs}
        predicted = self._predict(Gaussian(velocity, stored), acceleration, road)
        first = {(i, j): stored[i, j].like(variances[i] if i == j else 0.0) for i, j in pairs}
        x = choose_state(begins, Gaussian(initial, first), predicted)
        x = self._correct(x, {0: None}, speed - x.mean[0], car.wheel_speed_std_mps, logged["speed"])
        x = self._correct(x, {2: None}, rate - x.mean[2], car.yaw_rate_std_rad_s, rate)
        motion = self._rates(x.mean, road)
        row = {0: motion.ay[0], 1: motion.ay[1], 2: motion.ay[2], 3: None}
        innovation = (now["ay"] - motion.lateral - x.mean[3]).within(2 * ACCELERATION_MPS2)
        x = self._correct(x, row, innovation, car.ay_std_mps2, logged["ay"])

        self._keep(velocity, stored, x)
        self._next += [(held[name], now[name]) for name in held]
        runs = arrives.at_most(started.at_least(begins))
        for state, value in [*self._next, (started, started.like(1.0))]:
            self.low.do("next", choose(runs, value, state).step, state.step)
        angle = _arctan(x.mean[1], x.mean[0].at_least(SLOWEST_ANGLE_MPS))
        return angle.where(runs).step

    def _state(self, limit: float, bits: int = STATE) -> Number:
        """Return a number of the tick before, within ±limit; 0 at the start of a drive."""
        slot = sum(1 for step in self.low.steps if step.name == "state")
        bound = round(limit * 2**bits)
        return Number(self.low, self.low.do("state", slot, bound), bits)

    def _keep(
        self,
        means: Sequence[Number],
        covariance: Mapping[tuple[int, int], Number],
        following: "Gaussian",
    ) -> None:
        """Replace the stored mean and covariance after the tick."""
        self._next += zip(means, following.mean, strict=True)
        self._next += [(stored, following.covariance[at]) for at, stored in covariance.items()]

    def _inputs(self) -> dict[str, Number]:
        """Return the logged inputs in SI units by name; missing where the signals are missing."""
        inputs = {}
        for name, limit in _LIMITS.items():
            entry: ObserverInput | None = getattr(self.observer, name)
            if entry is None:
                continue
            columns = (Number(self.low, self.low.column(column), 0) for column in entry.of)
            total = reduce(Number.__add__ if entry.adds else Number.__sub__, columns)
            value = total.times(entry.scale, STATE)
            inputs[name] = (value - entry.offset if entry.offset else value).within(limit)
        return inputs

    def _ax_from(self, speed: Number, before: Number, begins: Number) -> Number:
        """Return the acceleration from the change of the wheels' speed, with a lag."""
        lagged = self._state(ACCELERATION_MPS2)
        change = (speed - before).times(1 / STEP_S).within(ACCELERATION_MPS2)
        zero = lagged.like(0.0)
        following = (lagged + (change - lagged).times(LAG_SHARE)).within(ACCELERATION_MPS2)
        new = choose(begins, zero, following)
        self._next.append((lagged, new))
        return new

    def _yaw_rate(
        self,
        logged: Mapping[str, Number],
        bias: Number,
        ax: Number,
        cosine: Number,
        begins: Number,
    ) -> Number:
        """Return the filtered yaw rate: state [r, bias of the gyroscope]."""
        car = self.car
        means = [self._state(YAW_RAD_S), bias]
        pairs = [(0, 0), (0, 1), (1, 1)]
        stored = {pair: self._state(VARIANCE, COVARIANCE) for pair in pairs}
        bias_variance = min(car.gyro_bias_std_rad_s**2, VARIANCE)
        first = {(0, 0): INITIAL_YAW_VARIANCE, (0, 1): 0.0, (1, 1): bias_variance}
        zero = means[0].like(0.0)
        start = Gaussian([zero, zero], {at: stored[at].like(first[at]) for at in pairs})
        x = choose_state(begins, start, Gaussian(means, stored))
        step = (STEP_S * car.yaw_acceleration_std_rad_s2) ** 2
        grown = (x.covariance[0, 0] + step).at_most(VARIANCE)
        x = Gaussian(x.mean, {**x.covariance, (0, 0): grown})
        gyro = logged["yaw_rate"]
        zero_where_missing = gyro.orelse(0.0)
        innovation = (zero_where_missing - x.mean[0] - x.mean[1]).within(2 * YAW_RAD_S)
        x = self._correct(x, {0: None, 1: None}, innovation, car.gyro_std_rad_s, gyro)
        wheels = self._wheel_yaw_rate(logged, ax, cosine)
        innovation = (wheels.orelse(0.0) - x.mean[0]).within(2 * YAW_RAD_S)
        x = self._correct(x, {0: None}, innovation, car.wheel_yaw_rate_std_rad_s, wheels)
        self._keep(means, stored, x)
        return x.mean[0]

    def _wheel_yaw_rate(self, logged: Mapping[str, Number], ax: Number, cosine: Number) -> Number:
        """Return the yaw rate of the wheels where they roll freely; at rest it is zero."""
        speed = logged["speed"]
        if "wheels" not in logged:
            rests = Number(self.low, self.low.constant(1), 0) - abs(speed).exceeds(0.0)
            return speed.like(0.0).where(rests.where(speed.present()).orelse(0.0))
        track = self.car.track_front_m if self.observer.axle == "front" else self.car.track_rear_m
        wheels = logged["wheels"].times(1 / track)
        if self.observer.axle == "front":
            wheels = wheels.over(cosine, STATE)
        return wheels.within(YAW_RAD_S).where(ax.exceeds(BRAKING_MPS2))

    def _axles(self, ax: Number, ay: Number, begins: Number) -> tuple["Axle", "Axle"]:
        """Return both axles under the load of the moment, which follows with a lag."""
        car = self.car
        wheelbase = car.front_axle_m + car.rear_axle_m
        lagged = []
        for value, lag_s in ((ax, car.pitch_lag_s), (ay, car.roll_lag_s)):
            state = self._state(ACCELERATION_MPS2)
            new = state + (value - state).times(STEP_S / lag_s)
            lagged.append(choose(begins, value, new).within(ACCELERATION_MPS2))
            self._next.append((state, lagged[-1]))
        pitch = lagged[0].times(car.height_m / wheelbase / 2)
        axles = []
        for sign, share, distance, track, peak in (
            (-1, car.front_roll_share, car.rear_axle_m, car.track_front_m, car.stiffness_front_n),
            (1, 1 - car.front_roll_share, car.front_axle_m, car.track_rear_m, car.stiffness_rear_n),
        ):
            static = GRAVITY_MPS2 * distance / wheelbase / 2
            mean = pitch + static if sign > 0 else -pitch + static
            roll = lagged[1].times(car.height_m * share / track)
            least = LEAST_LOAD * GRAVITY_MPS2 * car.front_axle_m / wheelbase / 2
            tyres = [
                self._tyre(load.at_least(least).at_most(ACCELERATION_MPS2), peak)
                for load in (mean - roll, mean + roll)
            ]
            stiffness = (tyres[0].stiffness + tyres[1].stiffness).within(STIFFNESS_MPS2)
            grip = (tyres[0].grip + tyres[1].grip).at_least(2.0**-8).at_most(GRIP_MPS2)
            axles.append(Axle(stiffness, grip))
        return axles[0], axles[1]

    def _tyre(self, load: Number, peak_n: float) -> "Axle":
        """Return stiffness, peak · 2x / (1 + x²), and grip of a tyre under a load."""
        car = self.car
        x = load.times(car.mass_kg / car.stiffness_load_n, RATIO)
        steep = (x * x).to(RATIO) + 1.0
        stiffness = x.times(2 * peak_n / car.mass_kg, STATE).over(steep, STATE)
        friction = car.friction * (1 + car.friction_load_sensitivity)
        per_load = car.friction * car.friction_load_sensitivity * car.mass_kg / car.nominal_load_n
        slack = load.times(-per_load, RATIO) + friction
        return Axle(stiffness, (slack * load).to(STATE))

    def _rates(self, mean: Sequence[Number], road: "WheelsOnRoad") -> "Accelerations":
        """Return the lateral and the yaw acceleration, with derivatives by vx, vy and r."""
        car, (vx, vy, r, _) = self.car, mean
        forces = []
        for axle, lever, steered in (
            (road.front, car.front_axle_m, True),
            (road.rear, -car.rear_axle_m, False),
        ):
            side = vy + r.times(lever)
            across, along = side, vx
            if steered:
                across = (road.cosine * side - road.sine * vx).to(STATE)
                along = (road.cosine * vx + road.sine * side).to(STATE)
            forces.append(_lateral_force(axle, across, along, road if steered else None))
        inertia = car.yaw_inertia_kgm2 / car.mass_kg
        levers = (car.front_axle_m, -car.rear_axle_m)
        turning = [
            [part.times(lever / inertia) for part in force]
            for force, lever in zip(forces, levers, strict=True)
        ]
        by_r = [force.per_vy.times(lever) for force, lever in zip(forces, levers, strict=True)]
        yaw_by_r = [part.times(lever / inertia) for part, lever in zip(by_r, levers, strict=True)]
        lateral, *derivatives = (a + b for a, b in zip(*forces, strict=True))
        yaw, *yaw_derivatives = (a + b for a, b in zip(*turning, strict=True))
        return Accelerations(
            lateral,
            yaw,
            [d.within(DERIVATIVE) for d in (*derivatives, by_r[0] + by_r[1])],
            [d.within(DERIVATIVE) for d in (*yaw_derivatives, yaw_by_r[0] + yaw_by_r[1])],
        )

    def _predict(self, x: "Gaussian", ax: Number, road: "WheelsOnRoad") -> "Gaussian":
        """Time update: x ← x + Δt f(x), P ← F P Fᵀ + Q, F = I + Δt ∂f/∂x."""
        car, (vx, vy, r, bias) = self.car, x.mean
        motion = self._rates(x.mean, road)
        mean = [
            (vx + (ax + (r * vy).to(STATE)).times(STEP_S)).within(VX_MPS),
            (vy + (motion.lateral - (r * vx).to(STATE)).times(STEP_S)).within(VY_MPS),
            (r + motion.yaw.times(STEP_S)).within(YAW_RAD_S),
            bias,
        ]
        ay_vx, ay_vy, ay_r = motion.ay
        slopes: list[list[Number | None]] = [  # F − I
            [None, r, vy],
            [ay_vx - r, ay_vy, ay_r - vx],
            [*motion.yaw_derivatives],
        ]
        f = [
            [None if slope is None else slope.times(STEP_S, TRANSITION) for slope in row]
            for row in slopes
        ]

        fp = [
            [
                _grow(x.entry(i, j), f[i], [x.entry(k, j) for k in range(3)]).within(2 * VARIANCE)
                for j in range(4)
            ]
            for i in range(3)
        ]
        stds = (car.ax_std_mps2, car.lateral_model_std_mps2, car.yaw_model_std_rad_s2)
        covariance = dict(x.covariance)
        for i in range(3):
            covariance[i, 3] = _bounded(fp[i][3], diagonal=False)
            for j in range(i, 3):
                value = _grow(fp[i][j], f[j], fp[i][:3])
                if i == j:
                    value = value + max((stds[i] * STEP_S) ** 2, 2.0**-COVARIANCE)
                covariance[i, j] = _bounded(value, diagonal=i == j)
        return Gaussian(mean, covariance)

    def _correct(
        self,
        x: "Gaussian",
        row: Mapping[int, Number | None],
        innovation: Number,
        std: float,
        measured: Number,
    ) -> "Gaussian":
        """Measurement update by a row H, K = P Hᵀ / (H P Hᵀ + R), where there is a measurement.

        None in the row means 1.
        """
        n = len(x.mean)

        def product(column: Callable[[int], Number], bits: int) -> Number:
            terms = [(column(j).to(bits), h) for j, h in row.items()]
            parts = [value if h is None else (value * h).to(bits) for value, h in terms]
            return reduce(Number.__add__, parts)

        derived = any(h is not None for h in row.values())
        u = [product(partial(x.entry, i), COVARIANCE) for i in range(n)]
        if derived:
            u = [value.within(2.0**7) for value in u]
        bits = TRANSITION if derived else COVARIANCE
        predicted = product(lambda j: u[j], bits).to(COVARIANCE)
        total = predicted.at_least(0.0) + max(std**2, 2.0**-COVARIANCE)
        gains = [value.over(total, GAIN).within(2.0 if derived else 31.0) for value in u]
        mean = [
            (value + (gain * innovation).to(STATE)).within(bound)
            for value, gain, bound in zip(x.mean, gains, _bounds(n), strict=True)
        ]
        covariance = {
            (i, j): _bounded(x.entry(i, j) - (gains[i] * u[j]).to(COVARIANCE), diagonal=i == j)
            for i, j in x.covariance
        }
        return choose_state(measured.present(), Gaussian(mean, covariance), x)


def _bounds(states: int) -> Sequence[float]:
    return (VX_MPS, VY_MPS, YAW_RAD_S, BIAS_MPS2) if states == 4 else (YAW_RAD_S, GYRO_BIAS_RAD_S)


def _bounded(value: Number, *, diagonal: bool) -> Number:
    """Clip a covariance; variances stay positive."""
    clipped = value.within(VARIANCE)
    return clipped.at_least(2.0**-COVARIANCE) if diagonal else clipped


def _grow(value: Number, row: Sequence[Number | None], column: Sequence[Number]) -> Number:
    """Return a value plus the product of a row of F − I and a column, rounded once."""
    products = [f * entry for f, entry in zip(row, column, strict=True) if f is not None]
    return value + reduce(Number.__add__, products).to(COVARIANCE)


@dataclass(frozen=True)
class Gaussian:
    """Mean and covariance of a state; pairs (i, j) with i up to j."""

    mean: Sequence[Number]
    covariance: Mapping[tuple[int, int], Number]

    def entry(self, i: int, j: int) -> Number:
        """Return an entry of the covariance, which is symmetric."""
        return self.covariance[min(i, j), max(i, j)]


def choose_state(condition: Number, first: Gaussian, second: Gaussian) -> Gaussian:
    """Return the first state where a condition is 1, else the second."""
    means = zip(first.mean, second.mean, strict=True)
    mean = [choose(condition, *pair) for pair in means]
    pairs = ((at, first.covariance[at], value) for at, value in second.covariance.items())
    return Gaussian(mean, {at: choose(condition, a, b) for at, a, b in pairs})


class Axle(NamedTuple):
    """Stiffness per slip and grip of both tyres of an axle, over the mass, in m/s²."""

    stiffness: Number
    grip: Number


class WheelsOnRoad(NamedTuple):
    """Direction of the front wheels, and both axles."""

    sine: Number
    cosine: Number
    front: Axle
    rear: Axle


class Force(NamedTuple):
    """Lateral force of an axle over the mass, and its derivatives by vx and by vy."""

    force: Number
    per_vx: Number
    per_vy: Number


class Accelerations(NamedTuple):
    """Lateral and yaw acceleration, and their derivatives by vx, vy and r."""

    lateral: Number
    yaw: Number
    ay: list[Number]
    yaw_derivatives: list[Number]


def _lateral_force(axle: Axle, across: Number, along: Number, road: WheelsOnRoad | None) -> Force:
    """Return the force of an axle by Fiala; `road` has the direction of steered wheels."""
    rolling = along.at_least(SLOWEST_MPS)
    turning = along.exceeds(SLOWEST_MPS)
    slip = (-across).over(rolling, RATIO).within(4.0)
    triple = axle.grip + axle.grip + axle.grip
    use = (axle.stiffness * slip).to(RATIO + STATE)
    use = Number(use.low, use.low.do("nearest", use.step, triple.step), RATIO).within(1.0)
    size = abs(use)
    cubic = (use * use).to(RATIO).times(1 / 3) - size + 1.0
    force = ((triple * use).to(STATE) * cubic).to(STATE)
    stuck = -size + 1.0
    per_slip = (axle.stiffness * (stuck * stuck).to(RATIO)).to(STATE).over(rolling, STATE)
    turned = choose(turning, slip, slip.like(0.0))
    if road is None:
        return Force(force, -(per_slip * turned).to(STATE), -per_slip)
    scaled = (per_slip * road.cosine).to(STATE)
    per_vy = -(scaled * ((turned * road.sine).to(RATIO) + road.cosine)).to(STATE)
    per_vx = -(scaled * ((turned * road.cosine).to(RATIO) - road.sine)).to(STATE)
    return Force((road.cosine * force).to(STATE), per_vx, per_vy)


def _series(x: Number, coefficients: Sequence[float]) -> Number:
    """Return a polynomial by Horner's rule."""
    *lower, total = coefficients
    result = x.like(total)
    for coefficient in reversed(lower):
        result = (x * result).to(x.bits) + coefficient
    return result


def _arctan(y: Number, x: Number) -> Number:
    """Return the angle of a vector with x > 0, in 2⁻¹⁶ rad."""
    size = abs(y)
    small, large = size.at_most(x), size.at_least(x)
    rotated = small.exceeds(large.times(TAN_PI_8))
    numerator = choose(rotated, small - large, small)
    q = numerator.over(choose(rotated, small + large, large).at_least(2.0**-STATE), RATIO).within(
        0.5
    )
    octant = (q * _series((q * q).to(RATIO), ARCTAN)).to(RATIO)
    octant = octant + choose(rotated, octant.like(math.pi / 4), octant.like(0.0))
    angle = choose(size.exceeds(x), -octant + math.pi / 2, octant).to(STATE)
    return choose((-y).exceeds(0.0), -angle, angle).within(ANGLE_RAD)


_LIMITS = {
    "ay": ACCELERATION_MPS2,
    "yaw_rate": YAW_RAD_S,
    "speed": VX_MPS,
    "steer": STEER_RAD,
    "ax": ACCELERATION_MPS2,
    "wheels": VX_MPS,
}
"""Inputs of an observer in order, and their limits."""


def lower_blend(low: "Lowering", blend: Blend) -> int:
    """Return the step of a combination of filter and line, in counts of 2⁻¹⁶ rad."""
    filtered = Number(low, low.column(blend.filter), STATE)
    if blend.line is None:
        return filtered.step
    difference = Number(low, low.column(blend.line), STATE) - filtered
    shares, limits = (_between_knots(low, blend, values) for values in (blend.shares, blend.limits))
    limit, share = Number(low, limits, STATE), Number(low, shares, SHARE_BITS)
    clipped = difference.at_most(limit).at_least(-limit)
    if blend.anchor == "line":
        added = difference - (clipped * (-share + 1.0)).to(STATE)
    else:
        added = (clipped * share).to(STATE)
    return (filtered + added.orelse(0.0)).within(ANGLE_RAD).step


def _between_knots(low: "Lowering", blend: Blend, values: Sequence[int]) -> int:
    """Return a value that is linear in the size of a column between its knots."""
    result = Number(low, low.constant(values[0]), 0)
    if blend.lateral is None:
        return result.step
    size = abs(Number(low, low.column(blend.lateral), 0))
    for (lower, upper), (before, after) in zip(
        pairwise(blend.knots), pairwise(values), strict=True
    ):
        rise = (size - lower).at_least(0).at_most(upper - lower)
        part = rise.over(rise.like(upper - lower), WEIGHT_BITS)
        weight = Number(low, part.step, WEIGHT_BITS)
        result = result + (weight * Number(low, low.constant(after - before), 0)).to(0)
    return result.step
