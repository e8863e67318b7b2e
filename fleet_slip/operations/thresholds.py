"""The thresholds of `configs/monitor.toml`."""

from functools import cache

from pydantic import Field

from fleet_slip.config import Config, load_config
from fleet_slip.resources import folder


class StatusThresholds(Config):
    """When `status` calls for attention.

    Attributes:
        min_free_fraction: least free part of the disk that holds the data root.
    """

    min_free_fraction: float = Field(ge=0, lt=1)


class Thresholds(Config):
    """All thresholds."""

    status: StatusThresholds


@cache
def thresholds() -> Thresholds:
    """Return the thresholds that ship with this installation."""
    return load_config(folder("configs") / "monitor.toml", Thresholds)
