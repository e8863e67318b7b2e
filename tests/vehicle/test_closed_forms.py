"""Small manoeuvres of the simulated cars against the closed forms of the linear bicycle.

The steering's first-order lag comes before the bicycle: closed forms are taken with it.
"""

from dataclasses import replace

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.dynamics import cornering_stiffness
from fleet_slip.vehicle.parameters import PERFECT, CarImperfections, constants, load_vehicle
from tests.support.linear_bicycle import LinearBicycle, steer

CARS = ("compact_hatchback", "d_class_sedan", "suv")
SPEED_MPS = 25.0
SMALL_RAD = 0.002
"""Angle of the road wheels: half a metre per second squared."""

TIME_S = np.arange(0.0, 4.0, 0.01)
RIGID = LinearBicycle.from_car(load_vehicle("d_class_sedan", SHIPPED_CONFIGS), SPEED_MPS)


def lagged_step(bicycle: LinearBicycle, lag_s: float) -> FloatArray:
    """Return the bicycle's response to a step that a lag has rounded: a convolution."""
    fine = np.arange(0.0, TIME_S[-1] + 0.01, 0.001)
    sharp = bicycle.step_response(fine)
    weight = np.exp(-fine / lag_s) / lag_s * 0.001
    smooth = np.array([np.convolve(part, weight)[: len(fine)] for part in sharp])
    return smooth[:, ::10][:, : len(TIME_S)]


@pytest.mark.parametrize("name", CARS)
def test_a_small_step_of_the_steering_answers_as_the_bicycle(name: str) -> None:
    car = load_vehicle(name, SHIPPED_CONFIGS)
    bicycle = LinearBicycle.from_car(car, SPEED_MPS)
    motion = steer(car, PERFECT, np.full(len(TIME_S), car.steering.ratio * SMALL_RAD), SPEED_MPS)
    vy, rate = SMALL_RAD * lagged_step(bicycle, car.steering.lag_s)
    assert motion.yaw_rate_rad_s[-1] == pytest.approx(SMALL_RAD * bicycle.yaw_gain_1ps, rel=0.03)
    assert np.abs(motion.yaw_rate_rad_s - rate).max() < 0.04 * rate.max()
    slip = vy / SPEED_MPS
    assert np.abs(motion.sideslip_rad - slip).max() < 0.05 * np.abs(slip).max()


@pytest.mark.parametrize("name", CARS)
@pytest.mark.parametrize("frequency_hz", [0.4, 1.0, 2.0])
def test_a_small_sine_of_the_steering_answers_as_the_bicycle(
    name: str, frequency_hz: float
) -> None:
    """Around the yaw resonance, in amplitude and phase."""
    car = load_vehicle(name, SHIPPED_CONFIGS)
    time_s = np.arange(0.0, 8.0, 0.01)
    wave = np.exp(2j * np.pi * frequency_hz * time_s)
    demand = car.steering.ratio * SMALL_RAD * wave.imag
    motion = steer(car, PERFECT, demand, SPEED_MPS)
    late = slice(300, 300 + round(2 / frequency_hz) * 100)
    amplitude = 2j * np.mean(motion.yaw_rate_rad_s[late] * wave.conj()[late]) / SMALL_RAD
    # The demand is held for 10 ms, on average 5 ms late.
    lag = 1 / (1 + 2j * np.pi * frequency_hz * car.steering.lag_s)
    held = np.exp(-2j * np.pi * frequency_hz * 0.005)
    expected = LinearBicycle.from_car(car, SPEED_MPS).yaw_response(frequency_hz) * lag * held
    assert abs(amplitude / expected - 1) < 0.05


def test_tyres_that_relax_answer_as_the_bicycle_with_two_more_states() -> None:
    """Each axle follows its lateral velocity u: L ḟ = v (u − f), and its force is −C f / v."""
    car, length_m, v = load_vehicle("d_class_sedan", SHIPPED_CONFIGS), 0.5, SPEED_MPS
    c = constants(car, 1.0)
    front = 2 * cornering_stiffness(c.static_front, c.stiffness_front, c) / v
    rear = 2 * cornering_stiffness(c.static_rear, c.stiffness_rear, c) / v
    matrix = np.array(
        [
            [0.0, -v, -front / c.mass, -rear / c.mass],
            [0.0, 0.0, -c.front * front / c.yaw_inertia, c.rear * rear / c.yaw_inertia],
            [v / length_m, c.front * v / length_m, -v / length_m, 0.0],
            [v / length_m, -c.rear * v / length_m, 0.0, -v / length_m],
        ]
    )
    relaxed = replace(RIGID, matrix=matrix, steering=np.array([0.0, 0.0, -v * v / length_m, 0.0]))
    expected = SMALL_RAD * lagged_step(relaxed, car.steering.lag_s)[1]
    demand = np.full(len(TIME_S), car.steering.ratio * SMALL_RAD)
    late = steer(car, CarImperfections(relaxation_length_m=length_m), demand, v).yaw_rate_rad_s
    assert np.abs(late - expected).max() < 0.04 * expected.max()
    at_once = SMALL_RAD * lagged_step(RIGID, car.steering.lag_s)[1]
    assert np.abs(late - at_once).max() > 0.05 * expected.max()


def test_a_compliant_steering_answers_as_a_softer_front_axle() -> None:
    car = load_vehicle("d_class_sedan", SHIPPED_CONFIGS)
    flaws = CarImperfections(steering_compliance_deg_per_kn=0.15)
    soft = LinearBicycle.from_car(car, SPEED_MPS, float(np.radians(0.15)) / 1000)
    demand = np.full(len(TIME_S), car.steering.ratio * SMALL_RAD)
    motion = steer(car, flaws, demand, SPEED_MPS)
    assert motion.yaw_rate_rad_s[-1] == pytest.approx(SMALL_RAD * soft.yaw_gain_1ps, rel=0.02)
    assert soft.yaw_gain_1ps < 0.8 * RIGID.yaw_gain_1ps
