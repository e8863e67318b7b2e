"""Where a drive comes from, as the column `source` says it, and which drives may train a model."""

from typing import Final

SCENARIO: Final = "scenario"
"""Source of the drives that models are evaluated on, and must never be trained on."""

RECEIVED: Final = "received"
"""Source of the drives whose cars sent Gram rows, and no log."""

RECEIVED_FILES: Final = "received/"
"""What stands before a digest in the column `file` of Gram rows without a log file."""

LONGEST_PAUSE_S: Final = 600
"""A pause that is longer begins another trip: road, load and warmth of the tyres may be others."""

ALL_DRIVES: Final = "true"
TRAINING_DRIVES: Final = f"source <> '{SCENARIO}'"
