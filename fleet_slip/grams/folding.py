"""How a cohort is divided into folds, and the columns that folds are made of."""

from typing import Literal

from pydantic import Field

from fleet_slip.config import Config

FoldKey = Literal["drive", "vehicle", "track", "day", "mass", "adhesion", "row"]

FOLD_KEYS: dict[str, str] = {
    "drive": "drive_id",
    "vehicle": "vehicle_id",
    "track": "track",
    "day": "day",
    "mass": "mass_kg",
    "adhesion": "adhesion",
    "row": "part",
}
"""What a fold may be made of, and the column that tells."""

ROW_FOLDS: FoldKey = "row"
"""Folds of single rows, as WEKA makes them. They leak: a test row's neighbours train the model."""


class Folding(Config):
    """By what a cohort is divided, and into how many folds."""

    by: FoldKey = "drive"
    count: int = Field(default=5, ge=2, le=1000)
