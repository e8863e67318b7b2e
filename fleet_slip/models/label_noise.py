"""How good the label of a cohort is: its noise, and what a model without one is known by."""

import math
from dataclasses import dataclass

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Record
from fleet_slip.catalog.course import STRAIGHT, STRAIGHT_COURSE, TURNED
from fleet_slip.config import load_toml
from fleet_slip.errors import ConfigError
from fleet_slip.grams.cohort import Cohort
from fleet_slip.grams.gram_files import by_signals, gram_table
from fleet_slip.grams.reader import open_grams
from fleet_slip.regression.gram import GramTable, packed_position
from fleet_slip.resources import Configs
from fleet_slip.warehouse.warehouse import Warehouse


def label_noise_deg(warehouse: Warehouse, cohort: Cohort) -> float | None:
    """Return the standard deviation of the label's noise, of all rows of a cohort together.

    A cross-validated error has it in it, as no model knows the noise of other drives. So has it the
    step of its counts, as a uniform error. None where no campaign states it in its `[sensors]`.
    """
    if not warehouse.logs.snapshot().rows:  # all rows are of messages: none is read for this
        return None
    with open_grams(warehouse, cohort.feature_set, cohort.predicate) as opened:
        rows = opened.label_sources(cohort.predicate)
    stated = [(n, _stated_rad(source, campaign, warehouse.configs)) for source, campaign, n in rows]
    total = sum(n for n, _ in stated)
    if not total or any(std is None for _, std in stated):
        return None
    variance = sum(n * std**2 for n, std in stated if std is not None) / total
    signals = warehouse.catalog.signals
    step = float(signals[signals.label].scale)
    return math.degrees(math.sqrt(variance + step**2 / 12))


def _stated_rad(source: str, campaign: str | None, configs: Configs) -> float | None:
    """Return the noise that a campaign states; None of measured drives and unknown campaigns."""
    if source != "simulated" or campaign is None:
        return None
    try:
        content = load_toml(configs.find("campaigns", campaign))
        if "sensors" not in content:
            content = load_toml(configs.find("campaigns", content["base"]))
        return float(content["sensors"]["sideslip_std_rad"])
    except (ConfigError, KeyError):  # its file was elsewhere
        return None


FEWEST_STRAIGHT = 100
ONE_WAY = 0.7
"""Share of one side beyond which bends cannot be told apart: 1 on a skid pad, 0.2 on a circuit."""


@dataclass(frozen=True)
class WithoutLabel(Record):
    """What changes of the course say of a model's error; None where it cannot be estimated.

    Attributes:
        change_s: over how long.
        error_deg: cross-validated, of changes of the course, with the noise of two fixes in it.
        noise_deg, noise_uncertainty_deg: of the course, where cars go straight on; over drives.
        angle_at_most_deg: bound of the angle's error over so long: what noise leaves of `error_deg`
            is of two independent errors, each of half the square.
        to_the_left: mean of the angles turned over their root mean square: 1 where cars turn to
            the left alone and as hard at any time, −1 to the right.
    """

    change_s: tuple[float, ...]
    error_deg: float
    noise_deg: float | None
    noise_uncertainty_deg: float | None
    angle_at_most_deg: float | None
    to_the_left: float

    @property
    def one_way(self) -> str | None:
        """The side that cars turn to if they hardly ever turn to the other."""
        if abs(self.to_the_left) < ONE_WAY:
            return None
        return "left" if self.to_the_left > 0 else "right"


def without_label(warehouse: Warehouse, cohort: Cohort, error_deg: float) -> WithoutLabel | None:
    """Return how good a model of such an error is; None unless it was learned from changes."""
    times = cohort.catalog.feature_set(cohort.feature_set).change_s
    if not times:
        return None
    straight: list[FloatArray] = []
    turned = square = rows = 0.0
    with open_grams(warehouse, cohort.feature_set, cohort.predicate) as opened:
        for batch in opened.batches(cohort.predicate):
            for names, lines, _ in by_signals(batch):
                if STRAIGHT not in names.split(","):
                    continue
                table = gram_table(names, lines)
                straight.append(_changes_straight_on(table))
                at = table.signals.index(TURNED)
                turned += float(table.sums[:, at].astype(np.float64).sum())
                square += float(table.products[:, packed_position(at, at)].astype(np.float64).sum())
                rows += float(table.n.sum())
    scale = math.degrees(cohort.catalog.input_scales[cohort.catalog.signals.label])
    noise, unsure = _noise(np.concatenate([*straight, np.zeros((2, 0))], axis=1), scale)
    left = None
    if noise is not None and unsure is not None:  # fast cars have less noise than others
        left = max(0.0, error_deg**2 - max(0.0, noise - 2 * unsure) ** 2)
    return WithoutLabel(
        change_s=tuple(float(one) for one in times),
        error_deg=error_deg,
        noise_deg=noise,
        noise_uncertainty_deg=unsure,
        angle_at_most_deg=None if left is None else math.sqrt(left / 2),
        to_the_left=turned / math.sqrt(rows * square) if square else 0.0,
    )


def _changes_straight_on(table: GramTable) -> FloatArray:
    """Return degrees of freedom and squares of changes about each drive's mean, shape (2, n)."""
    at, course = table.signals.index(STRAIGHT), table.signals.index(STRAIGHT_COURSE)
    rows = table.sums[:, at].astype(np.float64)
    some = rows > 1
    square = table.products[some, packed_position(course, course)].astype(np.float64)
    mean_square = table.sums[some, course].astype(np.float64) ** 2 / rows[some]
    return np.stack([rows[some] - 1, square - mean_square])


def _noise(changes: FloatArray, scale: float) -> tuple[float | None, float | None]:
    """Return the standard deviation of changes and its standard error; None of few."""
    rows, squares = changes
    if rows.sum() < FEWEST_STRAIGHT or len(rows) < 2:
        return None, None
    variance = float(squares.sum() / rows.sum())
    error = math.sqrt(float(((squares - variance * rows) ** 2).sum())) / float(rows.sum())
    return math.sqrt(variance) * scale, error / (2 * math.sqrt(variance)) * scale
