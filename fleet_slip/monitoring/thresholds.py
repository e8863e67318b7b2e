"""The thresholds of `configs/monitor.toml`."""

from functools import cache

from pydantic import Field

from fleet_slip.config import Config, load_config
from fleet_slip.resources import config_file


class StatusThresholds(Config):
    """When `status` calls for attention."""

    min_free_fraction: float = Field(ge=0, lt=1)
    """Least free part of the disk that holds the data root."""


class QualityThresholds(Config):
    """When `quality` finds a drive's sensors not in order.

    Attributes:
        min_rows: shorter drives are not examined.
        min_drives: fewest drives in order of a vehicle model to compare others with.
        min_correlation: a sign of turning contradicts the others at less than minus this.
        limit: how many spreads from the cohort's median a figure may be.
        offset_floor_counts, gain_floor, noise_floor: least spread of the figures between drives;
            noise_floor is of the logarithm of the noise.
        max_saturated_per_row: most values at the end of their range, per row.
    """

    min_rows: int = Field(gt=0)
    min_drives: int = Field(ge=8)
    min_correlation: float = Field(gt=0, lt=1)
    limit: float = Field(gt=0)
    offset_floor_counts: float = Field(gt=0)
    gain_floor: float = Field(gt=0)
    noise_floor: float = Field(gt=0)
    max_saturated_per_row: float = Field(gt=0)


class MonitorThresholds(Config):
    """When `monitor` calls a day an alarm.

    Attributes:
        min_training_days: fewest days to learn from what is usual.
        false_alarms_per_day: probability that a usual day is beyond a figure's limits.
    """

    min_training_days: int = Field(ge=3)
    false_alarms_per_day: float = Field(gt=0, lt=0.5)


class Thresholds(Config):
    """All thresholds."""

    status: StatusThresholds
    quality: QualityThresholds
    monitor: MonitorThresholds


@cache
def thresholds() -> Thresholds:
    """Return the thresholds that ship with this installation."""
    return load_config(config_file("monitor.toml"), Thresholds)
