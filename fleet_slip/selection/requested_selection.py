"""A selection as it was asked for, which can be published."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fleet_slip.selection.select_models import Selection
from fleet_slip.warehouse.minimum_cohort import tells_single_cars


@dataclass(frozen=True, kw_only=True)
class RequestedSelection(Selection[Any]):
    """A selection that can be published: it tells what it was made from.

    Attributes:
        model_list: what was compared, such as `table1`.
        config_sha256: checksum of all that says what to compare.
        left_out: the cars that `robust` left out, and their influence as a multiple of the median.
    """

    model_list: str
    config_sha256: str
    left_out: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return what `select --json` prints."""
        named = dict(self.left_out) if tells_single_cars() else {}
        return {**super().as_dict(), "vehicles_left_out": named}

    @classmethod
    def of(
        cls, selection: Selection[Any], model_list: str, config_sha256: str
    ) -> "RequestedSelection":
        """Return a selection with what it was made from."""
        return cls(**vars(selection), model_list=model_list, config_sha256=config_sha256)
