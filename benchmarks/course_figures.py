"""Figures of docs/course.md: error against the number of labelled cars, and one drive.

    python -m benchmarks.course_figures ROOT [--days 2] [--draws 3] [--output docs/images]

Simulates days of `fleet_course` into ROOT where they are missing, and publishes there. Every third
car is held out. A model of four columns and the cars' own offsets learns from the course of all
other cars, and from the labels of some; errors are those on the cars held out, the reference
sensor's own noise, 0.0286 deg, in them.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.report.error_charts import End, error_axes, finish_errors
from fleet_slip.comparison.report.time_series import band
from fleet_slip.pages.drawing import Picture, Size, colour, svg_file

COLUMNS = "steering_mean_16,ay_mean_16,ay_square_mean_16,yaw_rate_speed_mean_16"
OWN = ",ay_offset_alone,yaw_rate_offset_alone"
LABELLED = (2, 5, 10, 20)
FEWEST_OF_THEIR_OWN = 5
"""Cars whose offsets can be told apart."""


def of(cars: Sequence[str]) -> str:
    """Return the condition that a drive is of some cars."""
    return f"vehicle_id IN ({', '.join(repr(str(car)) for car in cars)})"


def prepare(root: str, days: int) -> Fleet:
    """Return a data root with what both ways of learning need."""
    fleet = fleet_slip.open(root)
    fleet.simulate("fleet_course", days=days)
    for name in ("signals", "delay", "calibration", "fleet", "course_fleet"):
        fleet.gram(name)
    return fleet


def learn(fleet: Fleet, draws: int) -> tuple[list[float], float, str, list[str]]:
    """Print and return the errors by labelled cars, that of the course, its model, and cars."""
    found = fleet.sql("SELECT DISTINCT vehicle_id FROM drives ORDER BY 1").fetchall()
    cars = [car for (car,) in found]
    held = cars[::3]
    others = [car for car in cars if car not in held]
    course = fleet.cohort(of(others)).select(label="course", features="course_fleet", model=COLUMNS)
    freed = fleet.publish("without_label", course, force=True).version.reference
    unlabelled = fleet.score(freed, of(held)).rmse_deg
    print(f"course of {len(others)} cars: {unlabelled:.4f} deg on {len(held)} others")
    errors = []
    for number in (*LABELLED, len(others)):
        own = OWN if number >= FEWEST_OF_THEIR_OWN else ""
        drawn = []
        for draw in range(draws if number < len(others) else 1):
            some = np.random.default_rng(draw).permutation(others)[:number].tolist()
            selection = fleet.cohort(of(some)).select(features="fleet", model=COLUMNS + own)
            version = fleet.publish(f"labels_{number}", selection, force=True).version
            drawn.append(fleet.score(version.reference, of(held)).rmse_deg)
        errors.append(float(np.mean(drawn)))
        print(
            f"labels in {number} cars: {errors[-1]:.4f} deg, {min(drawn):.4f} to {max(drawn):.4f}"
        )
    return errors, unlabelled, freed, held


def error_figure(errors: Sequence[float], course: float, cars: int, size: Size) -> Figure:
    """Draw the error over the number of labelled cars, that of the course across."""
    places = np.array([*LABELLED, cars], dtype=np.float64)
    axes = error_axes(size)
    axes.set_yscale("log")
    axes.set_ylim(0.1, 1.1 * max(errors))
    axes.set_xscale("log")
    ends = []
    for label, tone, values in (
        ("labels", "model_4", [*errors]),
        ("course, no label", "model_1", [course] * len(places)),
    ):
        axes.plot(places, values, color=colour(tone), linewidth=1.6, marker="o", markersize=3)
        ends.append(End(values[-1], label, tone))
    figure = finish_errors(axes, "cars with a reference sensor", ends, size)
    axes.set_xticks(places, [f"{place:g}" for place in places])
    axes.set_yticks(shown := (0.1, 0.12, 0.15, 0.2), [f"{tick:g}°" for tick in shown])
    axes.minorticks_off()
    return figure


def drive_figure(
    time_s: FloatArray, true_deg: FloatArray, told_deg: FloatArray, size: Size
) -> Figure:
    """Draw the angle of one drive, and what the model is off by."""
    figure = Figure(figsize=(size.width_in, 3.4))
    angle, error = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    lines: list[tuple[Axes, FloatArray, str, str]] = [
        (angle, told_deg, "model_1", "learned from the course"),
        (angle, true_deg, "truth", "reference sensor, never seen"),
        (error, told_deg - true_deg, "model_1", ""),
    ]
    for axes, values, tone, label in lines:
        one = band(time_s, values, size.bins)
        axes.plot(one.x, one.mean, color=colour(tone), linewidth=1.1, label=label or None)
    angle.legend(frameon=False, loc="upper right", ncols=2)
    angle.set_title("side-slip angle (deg)", color=colour("muted"))
    error.set_title("difference (deg)", color=colour("muted"))
    error.set_xlabel("time (s)", labelpad=2)
    figure.tight_layout()
    return figure


def one_drive(fleet: Fleet, model: str, car: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the times of a car's first drive, and both angles in deg."""
    drives = fleet.sql(f"SELECT min(drive_id) FROM drives WHERE {of([car])}").fetchall()
    log = fleet.sql(f"SELECT * FROM log WHERE drive_id = '{drives[0][0]}' ORDER BY tick").pl()
    numbers = fleet.sql(f"SELECT number, value FROM calibration WHERE {of([car])}").fetchall()
    log = log.with_columns(pl.lit(value).alias(name) for name, value in numbers)
    told = fleet.model(model).predict(log).to_numpy()
    true = log["sideslip_rad"].to_numpy()
    return log["tick"].to_numpy() / 100, np.degrees(true), np.degrees(told)


def main() -> None:
    """Learn, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("--days", type=int, default=2)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--output", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    fleet = prepare(options.root, options.days)
    errors, course, freed, held = learn(fleet, options.draws)
    found = fleet.sql("SELECT count(DISTINCT vehicle_id) FROM drives").fetchall()
    cars = found[0][0] - len(held)
    time_s, true, told = one_drive(fleet, freed, held[0])
    pictures = [
        Picture("course_labels", "", "", "", lambda size: error_figure(errors, course, cars, size)),
        Picture("course_drive", "", "", "", lambda size: drive_figure(time_s, true, told, size)),
    ]
    for picture in pictures:
        (options.output / f"{picture.key}.svg").write_text(svg_file(picture))


if __name__ == "__main__":
    main()
