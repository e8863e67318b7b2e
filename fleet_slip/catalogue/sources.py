"""Where a drive comes from, as the column `source` says it, and which drives may train a model."""

from typing import Final

SCENARIO: Final = "scenario"
"""Source of the drives that models are evaluated on, and must never be trained on."""

ALL_DRIVES: Final = "true"
TRAINING_DRIVES: Final = f"source <> '{SCENARIO}'"
