"""Drives in traffic: highway-env decides where a car goes among others, and how fast.

highway-env makes the road and fills it with cars that follow (IDM) and change lanes (MOBIL). Ours
is one of them, by a policy that a real car can drive. Its path and its speed are a plan for the
batch kernel. Episodes of half a minute at most, each with other cars, follow each other until the
drive is long enough. Where our car would wait it rolls on at `SLOWEST_MPS`.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import highway_env
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import ConfigError, RefusedError
from fleet_slip.simulation.roads import LINE_STEP_M, SLOWEST_MPS, SpeedLimits, SpeedProfile

if TYPE_CHECKING:
    from fleet_slip.simulation.drive_plans import Traffic

gymnasium.register_envs(highway_env)

EPISODE_S = 30.0
"""Longest time on one road before the next, with other cars."""
LOOK_AHEAD_M, LOOK_AHEAD_S = 4.0, 1.2
"""Our driver aims at a point of the target lane so far ahead, and so much more per speed."""
BENDS_AHEAD_M = (0.0, 6.0, 12.0, 20.0, 30.0, 45.0, 60.0)
"""Where the road is looked at for bends that limit the speed."""
SHARPEST_1PM = 0.125
"""No car turns within a smaller radius than 8 m."""
STEERING_S = 0.6
"""Time from straight ahead to the largest curvature."""
ELBOW_ROOM_M, SIGHT_M = 15.0, 150.0
"""No other car is so near where ours begins, and who is farther from it takes no part."""
LEFT_M = 1.0
"""A lane was left by a car that is so far beside its middle."""
PLACES, ANGLES = 2**13, 2**18
"""Places and speeds are rounded to 1/8192 m and m/s, angles to 1/262144 rad, after every step.

The last bit of a cosine differs between processors, and would decide in the end who goes first.
"""


class Site(NamedTuple):
    """One of highway-env's roads, and how it is asked for."""

    environment: str
    config: Callable[[int], Mapping[str, int]]
    """Its configuration for so many other cars."""
    start_m: float | None = 5.0
    """Where on its lane our car begins; None: where highway-env puts it."""
    destinations: tuple[str, ...] = ()
    """Where it may go."""
    ramp: tuple[str, str, int] | None = None
    """The lane on which every other episode begins."""


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
    """Return the name of a road with traffic. Raises `ConfigError` if there is none such."""
    if name not in SITES:
        raise ConfigError(f"{name!r} is not a road with traffic. Choose from: {', '.join(SITES)}")
    try:
        gymnasium.spec(SITES[name].environment)
    except gymnasium.error.Error as error:
        raise ConfigError(
            f"highway-env {highway_env.__version__} has no road {name!r}: {error}"
        ) from None
    return name


class Driver(IDMVehicle):  # type: ignore[misc]
    """Another car: as highway-env drives it, on rounded places, and never in an accident.

    The figures are highway-env's. Its intersection changes those of all cars of the process.
    """

    position: FloatArray
    heading: float
    speed: float
    lane: Any
    lane_index: tuple[str, str, int]
    COMFORT_ACC_MAX, COMFORT_ACC_MIN = 3.0, -5.0
    DISTANCE_WANTED = 10.0

    @classmethod
    def instead_of(cls, vehicle: Any) -> "Driver":
        """Return a driver in the place of one of highway-env's vehicles."""
        one = cls(
            vehicle.road,
            vehicle.position,
            vehicle.heading,
            vehicle.speed,
            getattr(vehicle, "target_lane_index", None),
            getattr(vehicle, "target_speed", None),
            getattr(vehicle, "route", None),
            getattr(vehicle, "enable_lane_change", True),
        )
        one.DELTA = getattr(vehicle, "DELTA", cls.DELTA)
        return one

    def step(self, dt: float) -> None:
        """Move on, to a rounded place."""
        super().step(dt)
        self.position = np.round(self.position * PLACES) / PLACES
        self.heading = round(self.heading * ANGLES) / ANGLES
        self.speed = round(self.speed * PLACES) / PLACES

    def on_state_update(self) -> None:
        """Find the lane, if the last one was left, among those that can be reached from it."""
        network = self.road.network
        station, offset = self.lane.local_coordinates(self.position)
        if abs(offset) < LEFT_M and 0 <= station <= self.lane.length:
            return
        place, heading = self.position, self.heading
        self.lane_index = min(
            _near(network, *self.lane_index[:2]),
            key=lambda index: network.get_lane(index).distance_with_heading(place, heading),
        )
        self.lane = network.get_lane(self.lane_index)


class OurDriver(Driver):
    """Our car: highway-env's choice of lane and gap, but steering and speed of a real car.

    It steers by pure pursuit of the target lane, brakes before bends, and keeps `limits`.
    """

    limits: SpeedLimits
    tick_s: float
    curvature_1pm = 0.0

    def act(self, action: Any = None) -> None:
        """Choose lane, curvature and acceleration."""
        super().act(action)
        v = max(self.speed, SLOWEST_MPS)
        aim, *bends = self._ahead((LOOK_AHEAD_M + LOOK_AHEAD_S * v, *BENDS_AHEAD_M))
        lane, station = aim
        dx, dy = lane.position(station, 0.0) - self.position
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        wanted = 2 * (cosine * dy - sine * dx) / (dx * dx + dy * dy)
        largest = min(self.limits.lateral_mps2 / v**2, SHARPEST_1PM)
        change = largest * self.tick_s / STEERING_S
        wanted = min(max(wanted, -largest), largest)
        before = self.curvature_1pm
        self.curvature_1pm = min(max(wanted, before - change), before + change)
        self.action = {"steering": 0.0, "acceleration": self._acceleration(bends)}

    def step(self, dt: float) -> None:
        """Move on along an arc."""
        turn = self.curvature_1pm * self.speed * dt
        self.heading += turn / 2
        super().step(dt)
        self.heading = round((self.heading + turn / 2) * ANGLES) / ANGLES

    def _acceleration(self, bends: Sequence[tuple[Any, float]]) -> float:
        """Return highway-env's acceleration, or what bends ahead leave of it, within the limits."""
        headings = [float(lane.heading_at(station)) for lane, station in bends]
        chosen = float(self.action["acceleration"])
        for i, to_m in enumerate(BENDS_AHEAD_M[1:]):
            turn = abs(math.remainder(headings[i + 1] - headings[i], 2 * math.pi))
            from_m = BENDS_AHEAD_M[i]
            squared = self.limits.lateral_mps2 * (to_m - from_m) / max(turn, 1e-6)
            chosen = min(chosen, (squared - self.speed**2) / (2 * max(from_m, LOOK_AHEAD_M)))
        return min(max(chosen, -self.limits.braking_mps2), self.limits.acceleration_mps2)

    def onward(self, index: tuple[str, str, int]) -> tuple[str, str, int] | None:
        """Return the lane after a lane, None where the road ends or only leads back."""
        start, end, _ = index
        if self.road.network.graph.get(end, {}).keys() <= {start}:
            return None
        rest = [step for step in self.route or () if step[0] == end][:1]
        return self.road.network.next_lane(index, rest, self.position)  # type: ignore[no-any-return]

    def _ahead(self, distances_m: Sequence[float]) -> list[tuple[Any, float]]:
        """Return lane and station at distances along the route, from the target lane on."""
        network = self.road.network
        found = []
        for distance_m in distances_m:
            index = self.target_lane_index
            lane = network.get_lane(index)
            station = float(lane.local_coordinates(self.position)[0]) + distance_m
            while station > lane.length and (onward := self.onward(index)):
                station -= lane.length
                index, lane = onward, network.get_lane(onward)
            found.append((lane, station))
        return found


@dataclass(frozen=True)
class TrafficDrive:
    """What highway-env decided of a drive, before a car drives it."""

    profile: SpeedProfile
    station_m: FloatArray
    """Way of our car at each of highway-env's steps, (steps,)."""
    others: tuple[FloatArray, ...]
    """Of each step the other cars, (cars, 3): m ahead of ours, m to its left, rad to the left."""

    def others_at(self, station_m: float) -> FloatArray:
        """Return the other cars when ours is at a station, between two steps in proportion."""
        last = len(self.others) - 1
        before = min(max(int(np.searchsorted(self.station_m, station_m)) - 1, 0), last)
        here, there = self.others[before], self.others[min(before + 1, last)]
        if here.shape != there.shape or before == last:
            return here
        gone_m = self.station_m[before + 1] - self.station_m[before]
        share = min(max((station_m - self.station_m[before]) / max(gone_m, 1e-9), 0.0), 1.0)
        between: FloatArray = here + share * (there - here)
        return between


class Moment(NamedTuple):
    """One step of highway-env, from its beginning."""

    speed_mps: float
    curvature_1pm: float
    length_m: float
    others: FloatArray


def drive_in_traffic(
    traffic: "Traffic",
    limits: SpeedLimits,
    speed_factor: float,
    spacing_m: float,
    generator: np.random.Generator,
) -> TrafficDrive:
    """Let highway-env drive a car; a function of its arguments alone, on every machine.

    `speed_factor` is the speed that the driver wants over what the road or `limits` allow.
    """
    steps: list[Moment] = []
    left_s, before = traffic.duration_s, None
    environments = {
        name: _environment(name, traffic.others, traffic.decisions_hz)
        for name in sorted({*traffic.roads})
    }
    for name in cycle(traffic.roads):
        scene = SITES[name], environments[name]
        for step in _episode(*scene, limits, speed_factor, before, generator):
            if left_s <= 0:
                return _planned(traffic, steps, speed_factor, spacing_m)
            steps.append(step)
            left_s -= step.length_m / max(step.speed_mps, SLOWEST_MPS)
            before = step
    raise AssertionError("unreachable: roads are driven again and again")


def _planned(
    traffic: "Traffic", steps: Sequence[Moment], speed_factor: float, spacing_m: float
) -> TrafficDrive:
    lengths = np.array([step.length_m for step in steps])
    ends: FloatArray = np.cumsum(lengths)
    station_m = ends - lengths
    points = max(2, round(float(ends[-1]) / LINE_STEP_M)) + 1
    line_m = np.linspace(0.0, float(ends[-1]), points)
    curvature = np.interp(line_m, (station_m + ends) / 2, [step.curvature_1pm for step in steps])
    track = traffic.track.through(curvature, float(line_m[1]))
    grid_m, even_m = track.grid(spacing_m)
    speed = np.interp(grid_m, station_m, [max(step.speed_mps, SLOWEST_MPS) for step in steps])
    profile = SpeedProfile(track, even_m, grid_m, speed / speed_factor)
    return TrafficDrive(profile, station_m, tuple(step.others for step in steps))


def _episode(
    site: Site,
    environment: Any,
    limits: SpeedLimits,
    speed_factor: float,
    before: Moment | None,
    generator: np.random.Generator,
) -> Iterator[Moment]:
    """Yield the steps on one road, to its end or for `EPISODE_S`, after a step on another."""
    environment.reset(seed=int(generator.integers(2**31)))
    road, theirs = environment.road, environment.vehicle
    index = theirs.lane_index
    if site.ramp and generator.random() < 0.5:
        index = site.ramp
    lane = road.network.get_lane(index)
    start_m = site.start_m
    if start_m is None:
        start_m = float(lane.local_coordinates(theirs.position)[0])
    speed_mps = max(before.speed_mps if before else theirs.speed, SLOWEST_MPS)
    ours = OurDriver(road, lane.position(start_m, 0.0), lane.heading_at(start_m), speed_mps)
    ours.limits, ours.tick_s = limits, 1 / environment.config["simulation_frequency"]
    ours.curvature_1pm = -before.curvature_1pm if before else 0.0
    ours.lane, ours.lane_index, ours.target_lane_index = lane, index, index
    ours.target_speed = speed_factor * min(limits.top_speed_mps, lane.speed_limit)
    if site.destinations:
        ours.plan_route_to(site.destinations[generator.integers(len(site.destinations))])
    others = [
        Driver.instead_of(one)
        for one in road.vehicles
        if one is not theirs and _apart_m(one, ours) > ELBOW_ROOM_M
    ]
    for one in (ours, *others):
        one.check_collisions = False
    for _ in range(round(EPISODE_S / ours.tick_s)):
        others = [one for one in others if _apart_m(one, ours) < SIGHT_M]
        road.vehicles = [ours, *others]
        if ours.lane.after_end(ours.position) and ours.onward(ours.lane_index) is None:
            return
        road.act()
        length_m = max(ours.speed, 0.0) * ours.tick_s
        yield Moment(ours.speed, -ours.curvature_1pm, length_m, _seen_from(ours, others))
        road.step(ours.tick_s)


def _apart_m(one: Any, other: Any) -> float:
    return math.dist(one.position.tolist(), other.position.tolist())


def _seen_from(ours: OurDriver, others: Sequence[Driver]) -> FloatArray:
    """Return where others are from our car, (cars, 3); highway-env counts y to the right."""
    if not others:
        return np.zeros((0, 3))
    dx, dy = (np.array([one.position for one in others]) - ours.position).T
    cosine, sine = math.cos(ours.heading), math.sin(ours.heading)
    turned = ours.heading - np.array([one.heading for one in others])
    return np.stack([cosine * dx + sine * dy, sine * dx - cosine * dy, turned], axis=1)


def _environment(name: str, others: int, decisions_hz: int) -> Any:
    site = SITES[name]
    config = {**site.config(others), "simulation_frequency": decisions_hz}
    return gymnasium.make(site.environment, config=config, disable_env_checker=True).unwrapped


def _near(network: Any, start: str, end: str) -> list[tuple[str, str, int]]:
    """Return the lanes of a road of a network, and of the roads that lead to it and from it."""
    known = network.__dict__.setdefault("near", {})
    if (start, end) not in known:
        known[start, end] = [
            (a, b, number)
            for a, roads in network.graph.items()
            for b, lanes in roads.items()
            if (a, b) == (start, end) or a == end or b == start
            for number in range(len(lanes))
        ]
    return known[start, end]  # type: ignore[no-any-return]


REFERENCE_SEED, REFERENCE_STEPS = 1, 30
REFERENCE_LIMITS = SpeedLimits(
    lateral_mps2=4.0, acceleration_mps2=3.0, braking_mps2=6.0, top_speed_mps=36.0
)
REFERENCES = {
    "highway": "a5d51df2f2f1fa0d",
    "intersection": "97be659f01d322ec",
    "merge": "e468792a36b646e1",
    "racetrack": "b77efe7d4e8afafe",
    "roundabout": "fcdf70acb58dfa82",
    "two_way": "e8b15fe1d816e68b",
}
"""Of each road, a digest of where highway-env 1.12.1 takes all cars in three seconds."""


def require_known_traffic(name: str) -> None:
    """Raise `RefusedError` if highway-env's traffic on a road is not what it was."""
    generator = np.random.default_rng(REFERENCE_SEED)
    scene = SITES[name], _environment(name, 6, 10)
    steps = islice(_episode(*scene, REFERENCE_LIMITS, 1.0, None, generator), REFERENCE_STEPS)
    places = np.concatenate([np.append(step.others, step.speed_mps) for step in steps])
    digest = hashlib.sha256(np.round(places * 1000).astype("<i4").tobytes()).hexdigest()[:16]
    if digest != REFERENCES[name]:
        raise RefusedError(
            f"cars of highway-env {highway_env.__version__} drive on its road {name!r} unlike "
            f"those of the tested version ({digest}). The drives are not written: install the "
            "version that constraints.txt names."
        )
