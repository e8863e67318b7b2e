"""The environment for controllers: what gymnasium demands, and that its car is the fleet's."""

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from fleet_slip.errors import UsageError
from fleet_slip.simulation.environment import TICK_S, WHEELS, SideSlipEnv, Trial
from fleet_slip.vehicle.highway import FourWheelVehicle
from tests.support.catalog import SIGNALS

NOTHING = np.zeros(4, dtype=np.float32)
GENTLE = {"speed_mps": 20.0, "steering_rad": 0.5, "adhesion": 1.0}
HARD = {"speed_mps": 25.0, "steering_rad": 2.5, "adhesion": 0.8}
FL, FR = 0, 1


def drive(options: dict[str, float], action: Any = NOTHING, **made: Any) -> list[dict[str, Any]]:
    """Return the infos of a whole episode, with what was observed and whether the car was lost."""
    env = SideSlipEnv(**made)
    env.reset(seed=3, options=options)
    found: list[dict[str, Any]] = []
    lost = over = False
    while not (lost or over):
        seen, reward, lost, over, info = env.step(np.asarray(action, dtype=np.float32))
        found.append({**info, "seen": seen, "reward": reward, "lost": lost})
    return found


@pytest.mark.filterwarnings("ignore:.*render_modes.*")
def test_gymnasium_makes_it_and_has_no_complaint() -> None:
    env = gymnasium.make("fleet_slip/SideSlip-v0")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.shape == (len(SIGNALS.inputs),)


def test_without_brakes_the_car_is_that_of_the_equations() -> None:
    infos = drive(GENTLE, sensors=False)
    car = FourWheelVehicle(None, [0.0, 0.0], speed=GENTLE["speed_mps"])
    trial = Trial(**GENTLE)
    for tick, info in enumerate(infos):
        # highway-env's action is the angle of the road wheels
        angle = math.atan(trial.steering_at(tick * TICK_S) / car.parameters.steering.ratio)
        car.act({"steering": angle, "acceleration": 0.0})
        car.step(TICK_S)
        assert info["yaw_rate_rad_s"] == pytest.approx(car.yaw_rate, abs=1e-9)
        assert info["sideslip_rad"] == pytest.approx(car.sideslip, abs=1e-9)


@pytest.mark.parametrize(("wheel", "sign"), [(FL, 1), (FR, -1)])
def test_a_brake_turns_the_car_to_its_side(wheel: int, sign: int) -> None:
    straight = {**GENTLE, "steering_rad": 1e-9}
    action = np.eye(len(WHEELS))[wheel] * 0.3
    after = drive(straight, action)[50]
    assert sign * after["yaw_rate_rad_s"] > 0.01
    assert after["vx_mps"] < drive(straight)[50]["vx_mps"]


def test_a_hard_turn_is_lost_and_a_gentle_one_is_not() -> None:
    lost, kept = drive(HARD), drive(GENTLE)
    assert lost[-1]["lost"]
    assert abs(lost[-1]["sideslip_rad"]) > math.radians(60)
    assert not kept[-1]["lost"]
    assert kept[-1]["time_s"] == pytest.approx(5.0)
    assert sum(one["reward"] for one in kept) > sum(one["reward"] for one in lost)


def test_sensors_are_noisy_and_in_counts_and_the_angle_is_not_among_them() -> None:
    env = SideSlipEnv()
    assert "sideslip" not in env.signals
    rows = np.array([one["seen"] for one in drive({**GENTLE, "steering_rad": 1e-9})], dtype=float)
    yaw = rows[:, env.signals.index("yaw_rate")]
    assert np.std(yaw) == pytest.approx(0.01, rel=0.15)
    counts = yaw / float(SIGNALS["yaw_rate"].scale)
    assert np.abs(counts - np.round(counts)).max() < 1e-3


def test_a_seed_makes_the_same_trial() -> None:
    def beginning(seed: int) -> list[float]:
        env = SideSlipEnv()
        first, info = env.reset(seed=seed)
        return [*first, *env.step(NOTHING)[0], info["adhesion"]]

    assert beginning(5) == beginning(5)
    assert beginning(5) != beginning(6)


def test_a_range_that_is_none_is_refused() -> None:
    with pytest.raises(UsageError, match="adhesion"):
        SideSlipEnv(adhesion=(0.5, 0.1))
