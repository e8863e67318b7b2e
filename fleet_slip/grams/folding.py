"""Division of a cohort into folds."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field

from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.signals import LONGEST_PAUSE_S
from fleet_slip.config import Config
from fleet_slip.errors import DataError, QuestionError, UsageError
from fleet_slip.regression.folds import FoldAssignment, by_hash, by_value

FoldKey = Literal["drive", "vehicle", "track", "day", "mass", "adhesion", "speed", "part"]

FOLD_KEYS: dict[str, str] = {
    "drive": "trip",
    "vehicle": "vehicle_id",
    "track": "track",
    "day": "day",
    "mass": "mass_kg",
    "adhesion": "adhesion",
    "speed": "speed_factor",
    "part": "part",
}
"""Column of each fold key. The drives of a trip are segments of one, and share a fold."""

BANDS: FoldKey = "speed"
"""Folds are bands of speed, so that a model is tested on speeds that it was not trained on."""

PARTS: FoldKey = "part"
"""Folds are blocks of time, into which the feature set divides drives."""


EACH: Literal["each"] = "each"
"""Instead of a number of folds: each value of the key is a fold."""

FoldCount: TypeAlias = Annotated[int, Field(ge=2, le=1000)] | Literal["each"]

MAX_FOLDS = 10_000
"""Limit for `EACH`: each fold is an exact fit of every model."""


class Folding(Config):
    """Key and number of the folds of a cohort."""

    by: FoldKey = "drive"
    count: FoldCount = 5


def make_folding(by: FoldKey, count: int | str | None, usual: FoldCount) -> Folding:
    """Return a folding, by default of `usual` folds or all blocks. Raises `UsageError`."""
    if count is None:
        count = EACH if by == PARTS else usual
    try:
        return Folding.model_validate({"by": by, "count": count if count == EACH else int(count)})
    except ValueError:
        raise UsageError(
            f"folds = {count}: choose a number from 2 to 1000, or each: every {by} a fold of its "
            "own."
        ) from None


def require_blocks(catalog: Catalog, feature_set: str, by: str) -> None:
    """Raise `QuestionError` if folds need blocks and the feature set does not have any."""
    if by == PARTS and not catalog.feature_set(feature_set).block_ticks:
        divided = ", ".join(name for name, entry in catalog.sets.items() if entry.block_ticks)
        raise QuestionError(
            f"the feature set {feature_set} does not divide the rows of a drive. Feature sets with "
            f"blocks of time: {divided}."
        )


def assign_folds(values: Sequence[Any], by: str, count: FoldCount) -> FoldAssignment:
    """Assign Gram rows to folds by the values of a key. Raises `DataError` for one or too many."""
    if by == "drive" and len(set(values)) == 1:
        raise DataError(
            "cross-validation needs at least two folds, and the cohort is one drive, or one trip: "
            f"drives of a car less than {LONGEST_PAUSE_S // 60} minutes apart. Add logs, or hold "
            "out parts of the time: fleet-slip gram --features blocks, then fleet-slip select "
            "--features blocks --group-by part --save LIST.toml"
        )
    if count == EACH:
        if (number := len(set(values))) > MAX_FOLDS:
            raise DataError(
                f"the cohort has {number:,}, and at most {MAX_FOLDS:,} can be folds of their own. "
                f"Fold by another key than {by}, or say how many folds."
            )
        return by_value(values)
    if by == BANDS:
        return by_value(values, bands=count)
    if len(set(values)) > count:
        return by_hash([str(value) for value in values], count)
    return by_value(values)
