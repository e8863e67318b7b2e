"""Error of the side-slip angle over computing time, for schemes and steps: the choice of 2 ms.

    python -m benchmarks.work_precision [--plot docs/images/work-precision.svg]

Cars are driven by prescribed demands that jump every 10 ms, as a driver's do, in three manoeuvres
of 20 s: a slalom with braking and accelerating, the same beyond the grip of slippery roads, and
walking pace with full lock and stops. Each scheme steps the package's own equations of motion in
the same vectorised loop over lanes. The error is the largest over cars and time against the
converged solution, classical Runge-Kutta at 1/64 ms, itself checked against half of that. Each run
is timed several times, in time of the processor, and the best counts. A scheme that leaves the
solution by more than 5° is unstable.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numba
import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from benchmarks.schemes import SCHEMES
from fleet_slip.vehicle.driver import SAMPLE_S
from fleet_slip.vehicle.integration import FIRST_ORDER, SECOND_ORDER, STEP_S, Slopes
from fleet_slip.vehicle.lanes.lane_memory import LANES, read, write
from fleet_slip.vehicle.parameters import GRAVITY_MPS2, Constants, constants, load_vehicle
from fleet_slip.vehicle.state import Controls, State

SAMPLES = 2000
ROUNDS = 7
STEPS = (1, 2, 3, 4, 5, 7, 10, 20, 40, 80)
"""Steps of a sample of 10 ms."""
CONVERGED = 640
UNSTABLE_DEG = 5.0
COUNT_DEG = float(np.degrees(0.0001))
"""One count of the logged side-slip angle."""
DEFAULT_STEPS = round(SAMPLE_S / STEP_S)

STATE = 0
SLOPES = STATE + len(State._fields)
CONTROLS = SLOPES + len(Slopes._fields)
CAR = CONTROLS + len(Controls._fields)
ROWS = CAR + len(Constants._fields)


class Manoeuvre(NamedTuple):
    """What eight cars do: constants of each, and demands (samples, 2, cars)."""

    name: str
    cars: tuple[Constants, ...]
    speeds_mps: NDArray[np.float64]
    demands: NDArray[np.float64]


def manoeuvre(
    name: str,
    speeds_mps: tuple[float, float],
    lateral_mps2: float,
    adhesion: tuple[float, float],
    traction_mps2: float,
) -> Manoeuvre:
    """Return a slalom of eight sedans of different mass, with traction up and down."""
    sedan, number = load_vehicle("d_class_sedan"), np.arange(LANES)
    cars = tuple(
        constants(sedan.with_sprung_mass(1000.0 + 100.0 * i), float(mu))
        for i, mu in enumerate(np.linspace(*adhesion, LANES))
    )
    speeds = np.linspace(*speeds_mps, LANES)
    wheelbase = sedan.body.wheelbase_m
    lock = np.minimum(wheelbase * lateral_mps2 / speeds**2, 0.4) * sedan.steering.ratio
    t = SAMPLE_S * np.arange(SAMPLES)[:, None]
    steering = lock * np.sin(2 * np.pi * (0.2 + 0.03 * number) * t)
    drag = np.array([c.drag_per_mass for c in cars]) * speeds**2
    rolling = np.array([c.rolling_resistance for c in cars]) * GRAVITY_MPS2
    traction = drag + rolling + traction_mps2 * np.sin(2 * np.pi * (0.1 + 0.02 * number) * t)
    return Manoeuvre(name, cars, speeds, np.stack([steering, traction], axis=1))


MANOEUVRES = (
    manoeuvre("slalom, dry, 10 to 35 m/s", (10.0, 35.0), 5.0, (1.0, 1.0), 3.0),
    manoeuvre("beyond the grip, μ 0.3 to 0.8", (10.0, 30.0), 8.0, (0.3, 0.8), 4.0),
    manoeuvre("walking pace, full lock, stops", (1.0, 6.0), 8.0, (1.0, 1.0), 2.5),
)

Run = Callable[[NDArray[np.float64], NDArray[np.float64], int, NDArray[np.float64]], None]


def compiled(scheme: Callable[..., Any]) -> Run:
    """Return the loop over time and lanes with a scheme."""

    @numba.njit(nogil=True, error_model="numpy")
    def run(memory: Any, demands: Any, steps: int, velocity: Any) -> None:
        order = FIRST_ORDER
        for sample in range(len(demands)):
            for lane in range(LANES):
                velocity[sample, 0, lane] = memory[lane]
                velocity[sample, 1, lane] = memory[LANES + lane]
                write(
                    memory,
                    CONTROLS,
                    lane,
                    (demands[sample, 0, lane], demands[sample, 1, lane]),
                )
            for _ in range(steps):
                for lane in range(LANES):
                    x = read(memory, STATE, lane, State)
                    u = read(memory, CONTROLS, lane, Controls)
                    c = read(memory, CAR, lane, Constants)
                    before = read(memory, SLOPES, lane, Slopes)
                    after, slopes = scheme(x, u, c, before, SAMPLE_S / steps, order)
                    write(memory, STATE, lane, after)
                    write(memory, SLOPES, lane, slopes)
                order = SECOND_ORDER

    return run


def side_slip_deg(run: Run, task: Manoeuvre, steps: int) -> tuple[NDArray[np.float64], float]:
    """Return the side-slip angles (samples, cars) and the seconds that it took."""
    memory = np.zeros((ROWS, LANES))
    memory[CAR:] = np.array(task.cars).T
    memory[0] = task.speeds_mps
    memory[7:11] = task.speeds_mps * memory[CAR + Constants._fields.index("inverse_radius")]
    velocity = np.empty((SAMPLES, 2, LANES))
    start = time.thread_time()
    run(memory.reshape(-1), task.demands, steps, velocity)
    seconds = time.thread_time() - start
    # At rest side-slip has no meaning: below walking pace the lateral speed counts against that.
    return np.degrees(np.arctan2(velocity[:, 1], np.maximum(velocity[:, 0], 1.0))), seconds


class Point(NamedTuple):
    """One scheme at one step."""

    steps: int
    error_deg: float
    ns_per_sample: float

    @property
    def stable(self) -> bool:
        """Whether the scheme follows the solution at all."""
        return self.error_deg < UNSTABLE_DEG


def measure(run: Run, task: Manoeuvre, exact_deg: NDArray[np.float64]) -> list[Point]:
    """Return the points of a scheme in a manoeuvre."""
    points = []
    for steps in STEPS:
        with np.errstate(invalid="ignore"):
            runs = [side_slip_deg(run, task, steps) for _ in range(ROUNDS)]
            error = np.abs(runs[0][0] - exact_deg)
        worst = float(np.where(np.isfinite(error), error, np.inf).max())
        seconds = min(seconds for _, seconds in runs)
        points.append(Point(steps, worst, 1e9 * seconds / (SAMPLES * LANES)))
    return points


Results = dict[str, dict[str, list[Point]]]


def print_results(results: Results) -> None:
    """Print a table for each manoeuvre: error by scheme and step, and the time of a step."""
    for manoeuvre_name, schemes in results.items():
        print(f"\n{manoeuvre_name}: largest error of side-slip, deg (ns a sample)")
        print(f"{'step, ms':38}" + "".join(f"{1000 * SAMPLE_S / n:>16.3g}" for n in STEPS))
        for name, points in schemes.items():
            cells = (
                f"{p.error_deg:.2g} ({p.ns_per_sample:.0f})" if p.stable else "unstable"
                for p in points
            )
            print(f"{name:38}" + "".join(f"{cell:>16}" for cell in cells))


def draw(results: Results, file: Path) -> None:
    """Draw the work-precision diagram."""
    mpl.rcParams["svg.hashsalt"] = "fleet-slip"
    figure, axes = plt.subplots(
        1, len(results), figsize=(11, 4.8), sharey=True, layout="constrained"
    )
    for axis, (name, schemes) in zip(axes, results.items(), strict=True):
        for scheme, points in schemes.items():
            stable = [p for p in points if p.stable]
            line = axis.loglog(
                [p.ns_per_sample for p in stable],
                [p.error_deg for p in stable],
                marker="o",
                markersize=3,
                linewidth=2 if "default" in scheme else 1,
                label=scheme,
            )
            if "default" in scheme:
                chosen = next(p for p in points if p.steps == DEFAULT_STEPS)
                axis.plot(
                    chosen.ns_per_sample,
                    chosen.error_deg,
                    marker="*",
                    markersize=15,
                    color=line[0].get_color(),
                    zorder=5,
                )
        axis.axhline(COUNT_DEG, color="grey", linestyle=":", linewidth=1)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("time, ns per vehicle-sample")
        axis.grid(visible=True, which="major", alpha=0.3)
    axes[0].set_ylabel("largest error of side-slip angle, °")
    axes[0].annotate(
        "one logged count", (axes[0].get_xlim()[1], COUNT_DEG), ha="right", va="bottom", fontsize=8
    )
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=150, metadata={"Date": None} if file.suffix == ".svg" else None)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plot", type=Path, help="file of the diagram, SVG or PNG")
    arguments = parser.parse_args()
    schemes = {name: compiled(scheme) for name, scheme in SCHEMES.items()}
    reference = schemes["Runge-Kutta 4"]
    results: Results = {}
    for task in MANOEUVRES:
        exact_deg, _ = side_slip_deg(reference, task, CONVERGED)
        finer_deg, _ = side_slip_deg(reference, task, 2 * CONVERGED)
        print(f"{task.name}: converged to {np.abs(exact_deg - finer_deg).max():.1g} deg, ", end="")
        print(f"side-slip up to {np.abs(exact_deg).max():.1f} deg")
        for run in schemes.values():
            side_slip_deg(run, task, 1)
        results[task.name] = {name: measure(run, task, exact_deg) for name, run in schemes.items()}
    print_results(results)
    if arguments.plot:
        draw(results, arguments.plot)


if __name__ == "__main__":
    main()
