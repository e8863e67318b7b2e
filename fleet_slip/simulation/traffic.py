"""Drives in traffic: highway-env decides on the path and the speed of a car among other cars.

highway-env makes the road and fills it with cars that follow (IDM) and change lanes (MOBIL). The
simulated car is one of them, with a policy that a real car can follow. Its path and speed are a
plan for the batch kernel. Episodes of at most `EPISODE_S`, each with new cars, follow each other
until the drive is long enough. Where the car would wait, it rolls at `SLOWEST_MPS`.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import cycle, islice
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import highway_env
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import RefusedError
from fleet_slip.simulation.roads import LINE_STEP_M, SLOWEST_MPS, SpeedLimits, SpeedProfile

if TYPE_CHECKING:
    from fleet_slip.simulation.drive_plans import Traffic

gymnasium.register_envs(highway_env)

EPISODE_S = 30.0
"""Maximum time on one road in s, before the next road with new cars."""
LOOK_AHEAD_M, LOOK_AHEAD_S = 4.0, 1.2
"""Distance of the pursuit point on the target lane: constant, and per speed."""
BENDS_AHEAD_M = (0.0, 6.0, 12.0, 20.0, 30.0, 45.0, 60.0)
"""Preview points for bends that limit the speed, in m."""
MAX_CURVATURE_1PM = 0.125
"""Maximum curvature of a path: the turning circle of a car has a radius of 8 m."""
STEERING_S = 0.6
"""Time from straight ahead to the maximum curvature, in s."""
CLEARANCE_M, SIGHT_M = 15.0, 150.0
"""Other cars closer than this at the start are removed, and cars beyond this distance later."""
LANE_EXIT_M = 1.0
"""Offset from the middle of a lane at which a car leaves it, in m."""
POSITION_STEPS, ANGLE_STEPS = 2**13, 2**18
"""Positions and speeds are rounded to 1/8192 m and m/s, angles to 1/262144 rad, after every step.

The last bit of a cosine differs between processors, and would change the traffic in the end.
"""


class Site(NamedTuple):
    """A road of highway-env."""

    environment: str
    config: Callable[[int], Mapping[str, int]]
    """Configuration of the environment for a number of other cars."""
    start_m: float | None = 5.0
    """Start of our car on its lane; None: where highway-env puts it."""
    destinations: tuple[str, ...] = ()
    """Exits to choose from."""
    ramp: tuple[str, str, int] | None = None
    """Lane on which half of the episodes start."""


SITES = {
    "highway": Site("highway-v0", lambda n: {"lanes_count": 3, "vehicles_count": n}, None),
    "intersection": Site(
        "intersection-v2", lambda n: {"initial_vehicle_count": n}, 5.0, ("o1", "o2", "o3")
    ),
    "merge": Site("merge-generic-v1", lambda n: {"vehicles_count": n}, ramp=("j", "k", 0)),
    "racetrack": Site("racetrack-v1", lambda n: {"other_vehicles": n}),
    "roundabout": Site(
        "roundabout-generic-v1", lambda n: {"vehicles_count": n}, 5.0, ("exr", "nxr", "wxr")
    ),
    "two_way": Site("two-way-v0", lambda _: {}),
}


def require_road(name: str) -> str:
    """Return the name of a road with traffic. Raises `ValueError` if it is unknown."""
    if name not in SITES:
        raise ValueError(f"{name!r} is not a road with traffic. Choose from: {', '.join(SITES)}")
    try:
        gymnasium.spec(SITES[name].environment)
    except gymnasium.error.Error as error:
        raise ValueError(
            f"highway-env {highway_env.__version__} has no road {name!r}: {error}"
        ) from None
    return name


class Driver(IDMVehicle):  # type: ignore[misc]
    """Another car, driven by highway-env, with rounded positions and without collisions.

    The constants are highway-env's. They are repeated here because its intersection changes those
    of all cars of the process.
    """

    position: FloatArray
    heading: float
    speed: float
    lane: Any
    lane_index: tuple[str, str, int]
    COMFORT_ACC_MAX, COMFORT_ACC_MIN = 3.0, -5.0
    DISTANCE_WANTED = 10.0

    @classmethod
    def replacing(cls, vehicle: Any) -> "Driver":
        """Return a driver at the place of a vehicle of highway-env."""
        driver = cls(
            vehicle.road,
            vehicle.position,
            vehicle.heading,
            vehicle.speed,
            getattr(vehicle, "target_lane_index", None),
            getattr(vehicle, "target_speed", None),
            getattr(vehicle, "route", None),
            getattr(vehicle, "enable_lane_change", True),
        )
        driver.DELTA = getattr(vehicle, "DELTA", cls.DELTA)
        return driver

    def step(self, dt: float) -> None:
        """Advance to a rounded position."""
        super().step(dt)
        self.position = np.round(self.position * POSITION_STEPS) / POSITION_STEPS
        self.heading = round(self.heading * ANGLE_STEPS) / ANGLE_STEPS
        self.speed = round(self.speed * POSITION_STEPS) / POSITION_STEPS

    def on_state_update(self) -> None:
        """Find the nearest reachable lane after the car has left its lane."""
        network = self.road.network
        station, offset = self.lane.local_coordinates(self.position)
        if abs(offset) < LANE_EXIT_M and 0 <= station <= self.lane.length:
            return
        position, heading = self.position, self.heading
        self.lane_index = min(
            _connected_lanes(network, *self.lane_index[:2]),
            key=lambda index: network.get_lane(index).distance_with_heading(position, heading),
        )
        self.lane = network.get_lane(self.lane_index)


class OurDriver(Driver):
    """Our car: highway-env chooses lane and gap; steering and speed are those of a real car.

    It steers by pure pursuit of the target lane, brakes before bends, and stays within `limits`.
    """

    limits: SpeedLimits
    tick_s: float
    curvature_1pm = 0.0

    def act(self, action: Any = None) -> None:
        """Choose lane, curvature and acceleration."""
        super().act(action)
        v = max(self.speed, SLOWEST_MPS)
        (lane, station), *bends = self._ahead((LOOK_AHEAD_M + LOOK_AHEAD_S * v, *BENDS_AHEAD_M))
        dx, dy = lane.position(station, 0.0) - self.position
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        demand = 2 * (cosine * dy - sine * dx) / (dx * dx + dy * dy)
        largest = min(self.limits.lateral_mps2 / v**2, MAX_CURVATURE_1PM)
        change = largest * self.tick_s / STEERING_S
        demand = min(max(demand, -largest), largest)
        previous = self.curvature_1pm
        self.curvature_1pm = min(max(demand, previous - change), previous + change)
        self.action = {"steering": 0.0, "acceleration": self._acceleration(bends)}

    def step(self, dt: float) -> None:
        """Advance along an arc."""
        turn = self.curvature_1pm * self.speed * dt
        self.heading += turn / 2
        super().step(dt)
        self.heading = round((self.heading + turn / 2) * ANGLE_STEPS) / ANGLE_STEPS

    def _acceleration(self, bends: Sequence[tuple[Any, float]]) -> float:
        """Return highway-env's acceleration, limited by bends ahead and by `limits`."""
        headings = [float(lane.heading_at(station)) for lane, station in bends]
        acceleration = float(self.action["acceleration"])
        for i, to_m in enumerate(BENDS_AHEAD_M[1:]):
            turn = abs(math.remainder(headings[i + 1] - headings[i], 2 * math.pi))
            from_m = BENDS_AHEAD_M[i]
            squared = self.limits.lateral_mps2 * (to_m - from_m) / max(turn, 1e-6)
            bend = (squared - self.speed**2) / (2 * max(from_m, LOOK_AHEAD_M))
            acceleration = min(acceleration, bend)
        return min(max(acceleration, -self.limits.braking_mps2), self.limits.acceleration_mps2)

    def onward(self, index: tuple[str, str, int]) -> tuple[str, str, int] | None:
        """Return the lane after a lane; None if the road ends or only leads back."""
        start, end, _ = index
        if self.road.network.graph.get(end, {}).keys() <= {start}:
            return None
        route = [step for step in self.route or () if step[0] == end][:1]
        return self.road.network.next_lane(index, route, self.position)  # type: ignore[no-any-return]

    def _ahead(self, distances_m: Sequence[float]) -> list[tuple[Any, float]]:
        """Return lanes and stations at distances ahead along the route."""
        network = self.road.network
        points = []
        for distance_m in distances_m:
            index = self.target_lane_index
            lane = network.get_lane(index)
            station = float(lane.local_coordinates(self.position)[0]) + distance_m
            while station > lane.length and (onward := self.onward(index)):
                station -= lane.length
                index, lane = onward, network.get_lane(onward)
            points.append((lane, station))
        return points


class TrafficStep(NamedTuple):
    """State at the beginning of a step of highway-env."""

    speed_mps: float
    curvature_1pm: float
    length_m: float
    positions_m: FloatArray
    """Positions of all cars in the plane of highway-env, shape (cars, 2)."""


def drive_in_traffic(
    traffic: "Traffic",
    limits: SpeedLimits,
    speed_factor: float,
    spacing_m: float,
    generator: np.random.Generator,
) -> SpeedProfile:
    """Let highway-env plan the path and speed of a car; they depend on the arguments alone.

    `speed_factor` is the desired speed over the limit of the road or of `limits`.
    """
    steps: list[TrafficStep] = []
    remaining_s, previous = traffic.duration_s, None
    environments = {
        name: _environment(name, traffic.other_cars, traffic.decisions_hz)
        for name in sorted({*traffic.roads})
    }
    for name in cycle(traffic.roads):
        scene = SITES[name], environments[name]
        for step in _episode(*scene, limits, speed_factor, previous, generator):
            if remaining_s <= 0:
                return _planned(traffic, steps, speed_factor, spacing_m)
            steps.append(step)
            remaining_s -= step.length_m / max(step.speed_mps, SLOWEST_MPS)
            previous = step
    raise AssertionError("unreachable: the roads repeat")


def _planned(
    traffic: "Traffic", steps: Sequence[TrafficStep], speed_factor: float, spacing_m: float
) -> SpeedProfile:
    lengths = np.array([step.length_m for step in steps])
    ends: FloatArray = np.cumsum(lengths)
    station_m = ends - lengths
    points = max(2, round(float(ends[-1]) / LINE_STEP_M)) + 1
    line_m = np.linspace(0.0, float(ends[-1]), points)
    curvature = np.interp(line_m, (station_m + ends) / 2, [step.curvature_1pm for step in steps])
    track = traffic.track.through(curvature, float(line_m[1]))
    grid_m, even_m = track.grid(spacing_m)
    speed = np.interp(grid_m, station_m, [max(step.speed_mps, SLOWEST_MPS) for step in steps])
    return SpeedProfile(track, even_m, grid_m, speed / speed_factor)


def _episode(
    site: Site,
    environment: Any,
    limits: SpeedLimits,
    speed_factor: float,
    previous: TrafficStep | None,
    generator: np.random.Generator,
) -> Iterator[TrafficStep]:
    """Yield the steps on a road, to its end or for `EPISODE_S`, after a step on another road."""
    environment.reset(seed=int(generator.integers(2**31)))
    road, ego = environment.road, environment.vehicle
    index = ego.lane_index
    if site.ramp and generator.random() < 0.5:
        index = site.ramp
    lane = road.network.get_lane(index)
    start_m = site.start_m
    if start_m is None:
        start_m = float(lane.local_coordinates(ego.position)[0])
    speed_mps = max(previous.speed_mps if previous else ego.speed, SLOWEST_MPS)
    ours = OurDriver(road, lane.position(start_m, 0.0), lane.heading_at(start_m), speed_mps)
    ours.limits, ours.tick_s = limits, 1 / environment.config["simulation_frequency"]
    ours.curvature_1pm = -previous.curvature_1pm if previous else 0.0
    ours.lane, ours.lane_index, ours.target_lane_index = lane, index, index
    ours.target_speed = speed_factor * min(limits.top_speed_mps, lane.speed_limit)
    if site.destinations:
        ours.plan_route_to(site.destinations[generator.integers(len(site.destinations))])
    other_cars = [
        Driver.replacing(vehicle)
        for vehicle in road.vehicles
        if vehicle is not ego and _distance_m(vehicle, ours) > CLEARANCE_M
    ]
    for driver in (ours, *other_cars):
        driver.check_collisions = False
    for _ in range(round(EPISODE_S / ours.tick_s)):
        other_cars = [driver for driver in other_cars if _distance_m(driver, ours) < SIGHT_M]
        road.vehicles = [ours, *other_cars]
        if ours.lane.after_end(ours.position) and ours.onward(ours.lane_index) is None:
            return
        road.act()
        length_m = max(ours.speed, 0.0) * ours.tick_s
        positions_m = np.array([car.position for car in road.vehicles])
        yield TrafficStep(ours.speed, -ours.curvature_1pm, length_m, positions_m)
        road.step(ours.tick_s)


def _distance_m(a: Any, b: Any) -> float:
    return math.dist(a.position.tolist(), b.position.tolist())


def _environment(name: str, other_cars: int, decisions_hz: int) -> Any:
    site = SITES[name]
    config = {**site.config(other_cars), "simulation_frequency": decisions_hz}
    return gymnasium.make(site.environment, config=config, disable_env_checker=True).unwrapped


def _connected_lanes(network: Any, start: str, end: str) -> list[tuple[str, str, int]]:
    """Return the lanes of a road of a network, and of the roads that lead to it and from it."""
    cache = network.__dict__.setdefault("connected_lanes", {})
    if (start, end) not in cache:
        cache[start, end] = [
            (a, b, i)
            for a, roads in network.graph.items()
            for b, lanes in roads.items()
            if (a, b) == (start, end) or a == end or b == start
            for i in range(len(lanes))
        ]
    return cache[start, end]  # type: ignore[no-any-return]


REFERENCE_SEED, REFERENCE_STEPS = 1, 30
REFERENCE_LIMITS = SpeedLimits(
    lateral_mps2=4.0, acceleration_mps2=3.0, braking_mps2=6.0, top_speed_mps=36.0
)
REFERENCES = {
    "highway": "ae5c2d2f147062dd",
    "intersection": "c6a475fa56a2496b",
    "merge": "4390f14c363d0f77",
    "racetrack": "a42ff5d6f6cd5f15",
    "roundabout": "c3a7c440c90008c0",
    "two_way": "6b069874acb96b22",
}
"""Digests of the positions of all cars of highway-env 1.12.1 in three seconds, by road."""


def require_known_traffic(name: str) -> None:
    """Raise `RefusedError` if the traffic on a road differs from the tested highway-env."""
    generator = np.random.default_rng(REFERENCE_SEED)
    scene = SITES[name], _environment(name, 6, 10)
    steps = islice(_episode(*scene, REFERENCE_LIMITS, 1.0, None, generator), REFERENCE_STEPS)
    positions = np.concatenate([step.positions_m for step in steps])
    digest = hashlib.sha256(np.round(positions * 1000).astype("<i4").tobytes()).hexdigest()[:16]
    if digest != REFERENCES[name]:
        raise RefusedError(
            f"the traffic of highway-env {highway_env.__version__} on its road {name!r} differs "
            f"from that of the tested version ({digest}). The drives were not written. Install the "
            "version of constraints.txt and run the command again."
        )
