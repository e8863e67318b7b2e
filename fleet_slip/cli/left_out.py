"""Says which drives of a cohort what was computed leaves out."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from fleet_slip.cli.output import say
from fleet_slip.words import number_of

if TYPE_CHECKING:
    from fleet_slip.grams.cohorts.outweighing import Outweighing


def say_without_log(drives: int, feature_set: str) -> None:
    """Say how many drives have no Gram rows of a feature set, since their cars sent no log."""
    if drives:
        say(
            f"{number_of(drives, 'drive')} without a log left out: cars send Gram rows of the "
            f"logged signals, not of the feature set {feature_set}."
        )


def say_revoked(drives: Mapping[str, int]) -> None:
    """Say how many drives of each car do not count, since a revoked key signed them."""
    for car, many in drives.items():
        say(f"{number_of(many, 'drive')} of {car} left out: a key of it was revoked.")


def say_outweighing(outweighing: "Sequence[Outweighing]") -> None:
    """Say how many drives of each car do not count, since it would outweigh the others."""
    for one in outweighing:
        drives = f"{number_of(one.drives, 'drive')} of {one.vehicle_id}"
        say(f"{drives} left out: with them it would outweigh the others.")
