"""How a cohort is divided into folds, and the columns that folds are made of."""

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from fleet_slip.config import Config
from fleet_slip.errors import UsageError

FoldKey = Literal["drive", "vehicle", "track", "day", "mass", "adhesion", "speed", "part", "row"]

FOLD_KEYS: dict[str, str] = {
    "drive": "trip",
    "vehicle": "vehicle_id",
    "track": "track",
    "day": "day",
    "mass": "mass_kg",
    "adhesion": "adhesion",
    "speed": "speed_factor",
    "part": "part",
    "row": "part",
}
"""What a fold may be made of, and the column that tells.

Drives of one trip share a fold: they are pieces of one drive, of the same road, load and tyres."""

BANDS: FoldKey = "speed"
"""Whole bands of speed: neighbouring drives share a fold, so that no model sees their speed."""

PARTS: FoldKey = "part"
"""Parts of drives that the feature set divides rows into: bands of a signal, or blocks of time."""

ROW_FOLDS: FoldKey = "row"
"""Folds of single rows, as WEKA makes them. They leak: a test row's neighbours train the model."""


EACH: Literal["each"] = "each"
"""Instead of a number of folds: each drive, or vehicle, track or day, is a fold of its own."""

FoldCount: TypeAlias = Annotated[int, Field(ge=2, le=1000)] | Literal["each"]


class Folding(Config):
    """What divides a cohort, and into how many folds."""

    by: FoldKey = "drive"
    count: FoldCount = 5

    @model_validator(mode="after")
    def _rows_are_dealt(self) -> "Folding":
        if self.by == ROW_FOLDS and self.count == EACH:
            raise ValueError("folds of rows were dealt when the logs were read: say how many.")
        return self


def make_folding(by: FoldKey, count: int | str | None, usual: FoldCount) -> Folding:
    """Return a folding that was asked for, with the usual count if none is. Raises `UsageError`.

    Each part of drives is a fold of its own unless a number is asked for.
    """
    if count is None:
        count = EACH if by == PARTS else usual
    try:
        return Folding.model_validate({"by": by, "count": count if count == EACH else int(count)})
    except ValueError:
        each = "" if by == ROW_FOLDS else f", or each: every {by} a fold of its own"
        raise UsageError(f"folds = {count}: choose a number from 2 to 1000{each}.") from None
