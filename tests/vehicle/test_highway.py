"""The car among highway-env's vehicles, and its body beside that of its own bicycle."""

from typing import Any

import gymnasium
import highway_env
import numpy as np
import pytest
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.vehicle.dynamics import CALM, imperfect_derivative
from fleet_slip.vehicle.highway import FourWheelVehicle, LinearTyreVehicle, highway_twin
from fleet_slip.vehicle.parameters import State, load_vehicle
from tests.support.rolling import SEDAN, Run, rolling

gymnasium.register_envs(highway_env)


def test_without_its_extensions_the_car_moves_as_highway_env_s() -> None:
    """Rajamani, equations 2.21 to 2.28."""
    generator = np.random.default_rng(7)
    car = LinearTyreVehicle(None, [3.0, -2.0], heading=0.3, speed=20.0)
    twin = highway_twin(car)
    for _ in range(2000):
        vx, vy, yaw_rate = generator.normal(size=3) * np.array([25.0, 5.0, 1.0])
        vx = vx if abs(vx) > 1 else 25.0
        steering = generator.uniform(-1.2, 1.2)
        car.action = twin.action = {"steering": steering, "acceleration": generator.normal()}
        state = np.array([[0.0, 0.0, 0.3, vx, vy, yaw_rate]]).T
        ours, theirs = car.derivative_func(0.0, state), twin.derivative_func(0.0, state)
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def test_at_small_slip_the_car_moves_as_highway_env_s() -> None:
    generator = np.random.default_rng(8)
    car = FourWheelVehicle(None, [3.0, -2.0], heading=0.3, speed=20.0)
    twin, c = highway_twin(car), car.constants
    for _ in range(500):
        vx, steering = generator.uniform(15.0, 40.0), generator.uniform(-1e-4, 1e-4)
        vy, yaw_rate = generator.uniform(-1e-4, 1e-4, size=2) * np.array([vx, vx / 3])
        turn = yaw_rate * np.array([-c.half_track_width_front, c.half_track_width_front] * 2)
        wheels = dict(zip(State._fields[-4:], (vx + turn) * c.inverse_radius, strict=True))
        at_wheel = SEDAN.steering.ratio * np.tan(steering)
        car.last_motion = car.last_motion._replace(
            state=rolling(vx, steering_wheel=at_wheel)._replace(**wheels),
            compliance=car.last_motion.compliance._replace(rack=at_wheel),
        )
        car.action = twin.action = {"steering": steering, "acceleration": 0.0}
        state = np.array([[100.0, 100.0, 0.3, vx, vy, yaw_rate]]).T
        ours, _ = imperfect_derivative(
            car.last_motion.state._replace(vx=vx, vy=vy, yaw_rate=yaw_rate),
            car.controls,
            car.last_motion.compliance,
            CALM,
            c,
            car.imperfection_constants,
        )
        theirs = twin.derivative_func(0.0, state)[4:, 0]
        np.testing.assert_allclose([ours.vy, ours.yaw_rate], theirs, rtol=0.01, atol=2e-4)


def test_the_class_steps_as_the_equations_do() -> None:
    """Bit for bit: the class adds the place in the plane and nothing else."""
    car = FourWheelVehicle(None, [0.0, 0.0], speed=22.0)
    car.act({"steering": np.arctan(0.8 / SEDAN.steering.ratio), "acceleration": 1.0})
    for _ in range(10):
        car.step(0.1)
    demands = car.controls
    assert demands.steering_wheel == pytest.approx(0.8)
    run = Run(rolling(22.0), demands, seconds=1.0)
    assert car.motion == run.last


def test_velocity_includes_sliding() -> None:
    """Displacement over time agrees with `velocity`, which highway-env's own does not."""
    car = FourWheelVehicle(None, [0.0, 0.0], heading=1.0, speed=20.0)
    car.act({"steering": 0.05, "acceleration": 0.0})
    for _ in range(200):
        car.step(0.01)
    before, velocity = car.position, car.velocity
    car.step(0.002)
    assert abs(np.degrees(car.sideslip)) > 0.5
    np.testing.assert_allclose((car.position - before) / 0.002, velocity, atol=0.02)


def test_it_drives_among_others_on_a_road() -> None:
    road = Road(
        RoadNetwork.straight_road_network(3),
        np_random=np.random.RandomState(1),
        record_history=True,
    )
    car = FourWheelVehicle.make_on_lane(road, ("0", "1", 1), longitudinal=0.0, speed=25.0)
    other = IDMVehicle.make_on_lane(road, ("0", "1", 0), longitudinal=30.0, speed=20.0)
    road.vehicles += [car, other]
    for _ in range(30):
        road.act()
        road.step(1 / 15)
    assert car.position[0] == pytest.approx(50.0, abs=1.0)
    assert car.lane_index == ("0", "1", 1)
    assert len(car.history) == 30
    assert isinstance(car.history[0], FourWheelVehicle)
    assert car.history[0].motion == car.motion


def test_the_class_of_another_car_is_made_by_highway_env() -> None:
    class Suv(FourWheelVehicle):
        PARAMETERS = load_vehicle("suv", SHIPPED_CONFIGS)
        ADHESION = 0.5

    road = Road(RoadNetwork.straight_road_network(2), np_random=np.random.RandomState(1))
    car = Suv.create_random(road, speed=20.0)
    assert car.parameters.name == "suv"
    assert car.constants.friction == pytest.approx(0.55)
    assert Suv.create_from(car).parameters is car.parameters


@pytest.mark.parametrize("name", ["highway-v0", "racetrack-v1"])
def test_it_is_driven_by_a_real_environment(name: str) -> None:
    config = {"action": {"type": "ContinuousAction"}, "vehicles_count": 3, "other_vehicles": 1}
    env = gymnasium.make(name, config=config)
    env.reset(seed=3)
    inner: Any = env.unwrapped
    car = FourWheelVehicle.create_from(inner.vehicle)
    inner.road.vehicles[inner.road.vehicles.index(inner.vehicle)] = car
    inner.controlled_vehicles = [car]
    inner.define_spaces()
    for _ in range(5):
        observation, reward, *_ = inner.step(np.full(env.action_space.shape or (), 0.05))
        assert np.isfinite(observation).all()
        assert np.isfinite(reward)
    assert car.action["steering"] > 0
    assert car.yaw_rate > 0
    env.close()


def test_a_coarse_step_of_the_environment_is_as_good_as_a_fine_one() -> None:
    cars = [FourWheelVehicle(None, [0.0, 0.0], speed=2.0) for _ in range(2)]
    for car, calls, dt in ((cars[0], 15, 1 / 15), (cars[1], 500, 0.002)):
        car.act({"steering": 0.02, "acceleration": 0.5})
        for _ in range(calls):
            car.step(dt)
    np.testing.assert_allclose(cars[0].state, cars[1].state, atol=2e-3)
