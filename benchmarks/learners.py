"""What learners reach with ten times the rows, on the test drives and against the exact angle.

    python -m benchmarks.learners ROOT MODEL [--rows 600000] [--learners mlp,trees] [--drives A,B]
        [--signals]

They see the signals and the columns of the published model, as in `evaluate --rivals`, or signals
alone, and are fitted once. It prints the root mean square error and the standard deviation of the
error in degrees by drive, and the standard deviation inside of its sections and outside.
"""

import argparse
from pathlib import Path

import numpy as np

import fleet_slip
from fleet_slip.comparison.evaluation.evaluated_drives import load_drives
from fleet_slip.comparison.evaluation.scenario_runs import evaluate_drive
from fleet_slip.comparison.rivals.compare import all_signals
from fleet_slip.comparison.rivals.inputs import Inputs, LearnedEstimate, draw_sample
from fleet_slip.comparison.rivals.learner import one_thread
from fleet_slip.comparison.rivals.learners import OF_WINDOWS
from fleet_slip.grams.cohorts.gram_cohort import load_cohort
from fleet_slip.simulation.scenario import load_scenario

DRIVES = (
    "nominal", "noise_doubled", "melbourne", "mass_1740", "adhesion_0_7", "adhesion_0_4",
    "style_sporty", "style_limit", "biases_of_another_car", "car_suv", "imperfect",
)  # fmt: skip


def main() -> None:
    """Fit each learner and print its errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("model")
    parser.add_argument("--rows", type=int, default=600_000)
    parser.add_argument("--learners", default="mlp,trees")
    parser.add_argument("--drives", default=",".join(DRIVES))
    parser.add_argument("--signals", action="store_true", help="show them no other columns")
    asked = parser.parse_args()
    fleet = fleet_slip.open(asked.root)
    manifest = fleet.model(asked.model).manifest
    inputs = Inputs.of_model(manifest, all_signals())
    if asked.signals:
        inputs = Inputs.of_signals(all_signals())
    cohort = load_cohort(fleet.warehouse, manifest.trained_on.cohort)
    sample = draw_sample(fleet.warehouse, cohort, inputs, asked.rows)
    values = sample.of(inputs.names)
    drives = load_drives(fleet.warehouse, [load_scenario(name) for name in asked.drives.split(",")])
    print(f"{len(values):,} rows, {len(inputs.names)} columns", flush=True)
    for learner in OF_WINDOWS:
        if learner.name not in asked.learners.split(","):
            continue
        with one_thread():
            fitted = learner.fit(values, sample.sideslip_rad, sample.trip)
        for drive in drives:
            run = evaluate_drive(drive, {learner.name: LearnedEstimate(inputs, fitted)})
            found = run.results[learner.name]
            parts = [("rmse", found.whole.rmse_deg), ("std", found.whole.error_std_deg)]
            parts += [(f"in {part}", one.error_std_deg) for part, one in found.inside.items()]
            parts += [(f"not {part}", one.error_std_deg) for part, one in found.outside.items()]
            words = [f"{part} {value or np.nan:.4f}" for part, value in parts]
            print(f"| {learner.name} | {drive.scenario.name} | {' | '.join(words)} |", flush=True)
        print(f"{learner.name}: {fitted.size_bytes:,} bytes", flush=True)


if __name__ == "__main__":
    main()
