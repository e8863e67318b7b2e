"""Says which drives of a cohort what was computed leaves out."""

from collections.abc import Mapping

from fleet_slip.cli.output import say
from fleet_slip.regression.inference.influential import Influential
from fleet_slip.words import number_of

TELLING = 0.01
"""Part of a cohort's rows without the label or a signal that is worth a remark."""


def say_without_log(drives: int, feature_set: str) -> None:
    """Say how many drives have no Gram rows of a feature set, since their cars sent no log."""
    if drives:
        say(
            f"{number_of(drives, 'drive')} without a log left out: cars send Gram rows of the "
            f"logged signals, not of the feature set {feature_set}."
        )


def say_influential(cars: Mapping[str, Influential], what: str) -> None:
    """Say which cars have an influence that no honest car has, and what becomes of them."""
    for car, one in cars.items():
        say(
            f"{car} {what}: its influence on the model is {one.times:.0f} times the median one, "
            f"by what its rows give it ({one.rows:.1%} of all)."
        )


def say_without_information(rows: int, of: int) -> None:
    """Say how many rows of a cohort told nothing, if they are more than windows begin with."""
    if rows > TELLING * of:
        say(
            f"{rows:,} of {number_of(of, 'row')} tell nothing: the label or a signal of the model "
            "is missing there."
        )


def say_examined(told: str) -> None:
    """Say which drives were left out since they are not in order, if there are any."""
    if told:
        say(told)
