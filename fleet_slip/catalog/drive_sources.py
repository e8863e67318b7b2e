"""Values of the drive column `source`, and the drives that may train a model."""

from typing import Final

SCENARIO: Final = "scenario"
"""Drives for evaluation alone: no model is trained on them."""

MEASURED: Final = "measured"
"""Drives from logs of real cars."""

RECEIVED: Final = "received"
"""Drives whose cars sent Gram rows and no log."""

RECEIVED_FILES: Final = "received/"
"""Prefix of the column `file` of Gram rows without a log file; a digest follows."""

RECEIVER: Final = "receiver"
"""Drive column with the type of the satellite receiver."""

LONGEST_PAUSE_S: Final = 600
"""Longest pause within a trip, in s. Road, load and tyre temperature may change in longer ones."""

ALL_DRIVES: Final = "true"
TRAINING_DRIVES: Final = f"source <> '{SCENARIO}'"
