"""Combination of line and filter, whose weights are cross-validated in inner groups.

In every inner group of drives the car is identified, and the line chosen and fitted, without the
group. So the weights come from estimates that have not seen the labels.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import DataError
from fleet_slip.evaluation.filters import TUNING_DRIVES, TUNING_S, choose_evenly
from fleet_slip.evaluation.held_out import (
    QUARTERS,
    HeldOutDrive,
    Learner,
    Segments,
    folds_by_kind,
    predict_drive,
)
from fleet_slip.evaluation.identify import IdentifiedVehicle, identify
from fleet_slip.evaluation.single_track import LabelledDrive, hold_last
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.cohort import Cohort
from fleet_slip.models.predict import Predictor
from fleet_slip.regression.combination import (
    CombinationChoice,
    PairedEstimates,
    choose_combination,
)
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.vehicle.parameters import VehicleMeasures

MAX_GROUPS = 4
"""Inner groups of drives, each held out in turn."""

LATERAL_ROWS = 32
"""Rows of the mean of the lateral acceleration that shares depend on."""


@dataclass(frozen=True)
class CombinedEstimate:
    """A line, a filter in the identified car, and their combination.

    Attributes
    ----------
    choice
        The combination and its comparison.
    line
        The regression, fitted to all training segments.
    vehicle
        The car, identified from all training segments.
    cars
        Calibration parameters of each car.
    """

    choice: CombinationChoice
    line: Predictor
    vehicle: IdentifiedVehicle
    cars: CarCounts

    def __call__(self, drive: HeldOutDrive) -> FloatArray:
        """Estimate side-slip in rad, shape (rows,). Raises `MissingSignalError`."""
        line = predict_drive(self.line, self.cars, drive)
        angle_rad = self.vehicle.estimate(drive.signals)
        return self.choice.combination(line, angle_rad, lateral_mps2(drive))


def lateral_mps2(drive: LabelledDrive) -> FloatArray:
    """Return the size of the lateral acceleration, a mean of the last `LATERAL_ROWS` rows."""
    sums = np.cumsum(hold_last(drive.signals.ay_mps2, "ay"))
    before = np.concatenate([np.zeros(LATERAL_ROWS), sums])[: len(sums)]
    size: FloatArray = np.abs(sums - before) / np.minimum(np.arange(len(sums)) + 1, LATERAL_ROWS)
    return size


def training_drives(drives: Sequence[HeldOutDrive], held_out: Segments) -> list[LabelledDrive]:
    """Return the labelled drives without held-out segments; of many, the beginnings of some."""
    training = [drive.without(held_out) for drive in drives]
    training = [drive for drive in training if np.isfinite(drive.sideslip_rad).any()]
    rows = TUNING_S * SAMPLE_RATE_HZ
    if sum(len(drive.signals) for drive in training) > TUNING_DRIVES * rows:
        training = [drive.beginning(rows) for drive in choose_evenly(training, TUNING_DRIVES)]
    return training


def inner_groups(
    drives: Sequence[HeldOutDrive], held_out: Segments
) -> tuple[list[Segments], list[Segments]]:
    """Divide the training segments into groups of trips, and into kinds of driving.

    A single trip is divided into quarters of time. A kind that is a group of trips is left out.
    """
    training = frozenset((d.name, q) for d in drives for q in range(QUARTERS)) - held_out
    trips = {drive.name: drive.trip for drive in drives}
    names = list(dict.fromkeys(trips[name] for name in trips if (name, 0) in training))
    has_whole_drives = len(training) == QUARTERS * len({name for name, _ in training})
    if has_whole_drives and len(names) > 1:
        count = min(len(names), MAX_GROUPS)
        groups = [
            frozenset(part for part in training if names.index(trips[part[0]]) % count == group)
            for group in range(count)
        ]
    else:
        quarters = sorted({quarter for _, quarter in training})
        groups = [frozenset(part for part in training if part[1] == q) for q in quarters]
    kinds = folds_by_kind([drive for drive in drives if (drive.name, 0) in training])
    return groups, [kind for kind in kinds.values() if has_whole_drives and kind not in groups]


def combine(
    learner: Learner,
    drives: Sequence[HeldOutDrive],
    measures: VehicleMeasures,
    held_out: Segments,
    executor: Executor,
    *,
    cars: CarCounts,
    identified: IdentifiedVehicle | None = None,
    prior: Cohort | None = None,
) -> CombinedEstimate:
    """Choose a combination without held-out segments.

    `identified` is the car without these segments, if it is available. Raises `DataError` without
    labels, or without a signal that the filter needs, and as `Learner.train`.
    """
    identified = identified or identify(measures, training_drives(drives, held_out), executor)
    _, line = learner.train(held_out, prior)
    groups, kinds = inner_groups(drives, held_out)
    parts: list[list[PairedEstimates]] = []
    for number, group in enumerate([*groups, *kinds]):
        without = held_out | group
        training = training_drives(drives, without)
        vehicle = identify(measures, training, executor, start=identified)
        _, model = learner.train(without, prior)
        estimate = partial(predict_drive, model, cars)
        parts.append(list(_paired(drives, group, number, vehicle, estimate)))
    pairs, pairs_of_kinds = (
        [part for group in selected for part in group]
        for selected in (parts[: len(groups)], parts[len(groups) :])
    )
    if not pairs:
        raise DataError("no inner group has rows with a label and both estimates.")
    choice = choose_combination(
        PairedEstimates.concatenate(pairs),
        PairedEstimates.concatenate(pairs_of_kinds) if pairs_of_kinds else None,
    )
    return CombinedEstimate(choice, line, identified, cars)


def _paired(
    drives: Sequence[HeldOutDrive],
    group: Segments,
    number: int,
    vehicle: IdentifiedVehicle,
    line: Callable[[HeldOutDrive], FloatArray],
) -> Iterator[PairedEstimates]:
    """Yield both estimates of a group's labelled rows."""
    for drive in drives:
        rows = drive.rows_in(group) & np.isfinite(drive.sideslip_rad)
        if rows.any():
            estimates = line(drive), vehicle.estimate(drive.signals)
            rows &= np.isfinite(estimates[0] + estimates[1])
            numbers = np.full(len(rows), float(number))
            columns = (*estimates, drive.sideslip_rad, lateral_mps2(drive), numbers)
            yield PairedEstimates(*(values[rows] for values in columns))
