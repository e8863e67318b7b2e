"""What each imperfection of car, sensors and road costs an estimator, alone and all together.

    python -m benchmarks.realism [--root ROOT] [--tune] [--document docs/imperfections.md] [--rough]

Errors on the nominal test drive against its label as logged, each with one group of the figures of
the scenario `imperfect`; with --rough with one of what `fleet_rough` adds, of the middle of its
ranges. Models 4 and 5 of Table I are fitted to one day of `waterford` without any
imperfection; once more with the same imperfections in the training drives. The published model is
the champion of the ROOT given (fleet-slip --root ROOT run), and so are the columns that are fitted
once more. The EKF and the Kalman filter with GPS
know the car's parameters; with --tune their noises suit two of the training drives best.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np

import fleet_slip
from benchmarks.documents import insert
from benchmarks.realism_cases import Case, cases
from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.features import input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.columns.blocks.drive_columns import DriveColumns, as_counts
from fleet_slip.comparison.evaluation.estimators import (
    ColumnEstimate,
    LinearEstimate,
    published_estimate,
)
from fleet_slip.comparison.observers import ekf, kalman
from fleet_slip.comparison.observers.drive_signals import DriveSignals, LabelledDrive
from fleet_slip.comparison.observers.tuning import tune
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.selection.model_list import load_model_list
from fleet_slip.simulation.campaign import DriveSpec, load_campaign
from fleet_slip.simulation.drives import DriveLog, simulate_logs
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.simulation.sensing.sensors import GPS_SIGNALS

LABEL = catalogue().label
TABLE = {model.name: model.signals for model in load_model_list("table1").model}


def signals_of(log: DriveLog) -> dict[str, FloatArray]:
    """Return the SI columns of a drive, NaN where there is no fix."""
    columns: dict[str, FloatArray] = {}
    for name, counts in log.measurement.counts.items():
        values = counts.astype(np.float64) * float(catalogue()[name].scale)
        if name in GPS_SIGNALS:
            values[~log.measurement.gps_fix] = np.nan
        columns[catalogue()[name].column] = values
    return columns


def observed(log: DriveLog) -> LabelledDrive:
    """Return what filters see of a drive, and its label."""
    columns = signals_of(log)
    seen = DriveSignals(**{field.name: columns[field.name] for field in fields(DriveSignals)})
    return LabelledDrive(log.spec.drive_id, seen, columns[catalogue()[LABEL].column])


def table_one(logs: Sequence[DriveLog], name: str) -> LinearEstimate:
    """Fit one model of Table I to drives."""
    names = (*TABLE[name], LABEL)
    grams = [
        Gram.from_counts(
            names, np.stack([log.measurement.counts[n] for n in names], axis=1).astype(np.int64)
        )
        for log in logs
    ]
    fitted = fit(sum(grams[1:], grams[0]), TABLE[name], LABEL)
    return LinearEstimate.of(fitted.model.physical(input_scales()))


def fitted_again(published: ColumnEstimate, logs: Sequence[DriveLog]) -> ColumnEstimate:
    """Fit the columns of a published model to drives; rows without all of them are left out."""
    predictor, total = published.predictor, None
    names = (*published.manifest.signals, LABEL)
    for log in logs:
        counts = as_counts(signals_of(log), predictor.plan.signals, log.metadata)
        columns = DriveColumns(predictor.plan, counts).compute()
        rows = np.vstack([columns, log.measurement.counts[LABEL]])
        known = rows[:, np.isfinite(rows).all(axis=0)].astype(np.int64)
        gram = Gram.from_counts(names, known.T)
        total = gram if total is None else total + gram
    assert total is not None
    model = fit(total, names[:-1], LABEL).model.physical(input_scales())
    again = replace(
        predictor, intercept=model.offset, coefficients=tuple(model.weights[n] for n in names[:-1])
    )
    return replace(published, predictor=again)


def rmse_deg(estimate: FloatArray, label: FloatArray) -> float:
    """Return the root mean square of an estimate's error, in degrees."""
    return float(np.degrees(np.sqrt(np.nanmean((estimate - label) ** 2))))


Estimators = Mapping[str, Callable[[DriveLog], FloatArray]]


def fixed_estimators(
    training: Sequence[DriveLog], tuned: bool, published: LinearEstimate | ColumnEstimate | None
) -> Estimators:
    """Return the estimators that know of no imperfection, by the heading of their column."""
    car = load_campaign("waterford").plan.vehicles[0]
    ekf_noise, gps_noise = ekf.EkfNoise(), kalman.FilterNoise()
    if tuned:
        with ThreadPoolExecutor(2) as executor:
            some = [observed(log) for log in training[:: len(training) // 2]]
            ekf_noise = tune(ekf.estimate, ekf_noise, ekf.TUNABLE, some, car, executor).parameters
            gps_noise = tune(
                kalman.estimate, gps_noise, kalman.TUNABLE, some, car, executor
            ).parameters
    four, five = table_one(training, "4"), table_one(training, "5")
    found: dict[str, Callable[[DriveLog], FloatArray]] = {
        "model 4": lambda log: four(signals_of(log)),
        "model 5": lambda log: five(signals_of(log)),
        "EKF": lambda log: ekf.estimate(observed(log).signals, car, ekf_noise),
        "Kalman with GPS": lambda log: kalman.estimate(observed(log).signals, car, gps_noise),
    }
    if published is not None:
        both = {"model 4": found.pop("model 4"), "model 5": found.pop("model 5")}
        found = {**both, "published": partial(published_angle, published), **found}
    return found


def published_angle(published: LinearEstimate | ColumnEstimate, log: DriveLog) -> FloatArray:
    """Return what a published model estimates in a car that knows its metadata."""
    if isinstance(published, ColumnEstimate):
        return replace(published, facts=log.metadata)(signals_of(log))
    return published(signals_of(log))


def row(
    case: Case,
    training: Sequence[DriveSpec],
    test: DriveSpec,
    fixed: Estimators,
    published: LinearEstimate | ColumnEstimate | None,
) -> dict[str, float]:
    """Return the errors of all estimators in one case, by the heading of their column."""
    (log,) = simulate_logs([case.spec(test)])
    if log.lost_control_s is not None:
        raise RuntimeError(f"{case.name}: the driver lost the car")
    label = observed(log).sideslip_rad
    learned = simulate_logs([case.spec(drive) for drive in training])
    estimates = {
        f"model {name}, trained with it": table_one(learned, name)(signals_of(log))
        for name in ("4", "5")
    }
    if isinstance(published, ColumnEstimate):
        again = fitted_again(published, learned)
        estimates["published, trained with it"] = published_angle(again, log)
    estimates = {name: estimate(log) for name, estimate in fixed.items()} | estimates
    return {name: rmse_deg(estimate, label) for name, estimate in estimates.items()}


def table(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Return the errors as a table in Markdown."""
    columns = next(iter(rows.values()))
    lines = [("imperfection", *columns), ("---",) * (1 + len(columns))]
    lines += [(name, *(f"{found[c]:.3f}" for c in columns)) for name, found in rows.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", help="data root with a published model waterford")
    parser.add_argument("--tune", action="store_true", help="tune the filters; takes minutes")
    parser.add_argument("--document", type=Path, help="page to put the table into")
    parser.add_argument("--rough", action="store_true", help="what fleet_rough adds")
    arguments = parser.parse_args()
    campaign = load_campaign("waterford")
    training = campaign.drives(campaign.days()[0])
    (test,) = load_scenario("nominal").batch().drives
    published = None
    if arguments.root:
        published = published_estimate(fleet_slip.open(arguments.root).model("waterford").manifest)
    fixed = fixed_estimators(simulate_logs(training), arguments.tune, published)
    rows = {}
    for case in cases(arguments.rough):
        rows[case.name] = row(case, training, test, fixed, published)
        if len(rows) == 1:
            print(", ".join(rows[case.name]), flush=True)
        values = "".join(f"{value:9.3f}" for value in rows[case.name].values())
        print(f"{case.name:36}{values}", flush=True)
    if arguments.document:
        insert(arguments.document, "rough" if arguments.rough else "realism", table(rows))


if __name__ == "__main__":
    main()
