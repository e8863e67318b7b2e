"""What worse sensors would do to a model's error, in closed form: no drive is simulated again."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.errors import QuestionError
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.regression.exact.figures import Figures, error_sums
from fleet_slip.regression.exact.least_squares import LinearModel
from fleet_slip.regression.shrinkage.ridge import disturb, fit_noise_matched


@dataclass(frozen=True)
class WhatIf:
    """Figures of a model before and after bias and noise come, and of the best model after it."""

    drives: int
    before: Figures
    after: Figures
    refitted: LinearModel
    refitted_after: Figures

    def as_dict(self) -> dict[str, Any]:
        """Return what `what-if --json` prints."""
        return {
            "drives": self.drives,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "refitted_after": self.refitted_after.as_dict(),
            "refitted": {"intercept": self.refitted.offset, **self.refitted.weights},
        }


def what_if(
    cohort: Cohort,
    model: LinearModel,
    *,
    bias: Mapping[str, float],
    noise: Mapping[str, float],
    intercept: bool = True,
) -> WhatIf:
    """Return the figures to expect once bias and white noise come on top of what is logged.

    `model` is of counts; `bias` and `noise` (standard deviations) are in SI units. Raises
    `QuestionError` for a signal that the model lacks, or has in a feature: that is not linear.
    """
    for name in {*bias, *noise}:
        _require_linear(name, model)
    scales = input_scales()
    served = cohort.serving(model.signals)
    total = served.table.total()
    unit = scales[model.label]

    def after(one: LinearModel) -> Figures:
        return disturb(error_sums(one, total), one, scales, bias=bias, noise=noise).figures(unit)

    seen = total if intercept else total.about_origin()
    refitted = fit_noise_matched(seen, model.signals, model.label, noise, scales)
    return WhatIf(
        len(served.table),
        error_sums(model, total).figures(unit),
        after(model),
        refitted.physical(scales),
        after(refitted),
    )


def _require_linear(name: str, model: LinearModel) -> None:
    known = features().features
    inside = [f for f in model.signals if f in known and name in known[f].inputs]
    if inside:
        raise QuestionError(
            f"{name} also enters the model through {', '.join(inside)}, where its error has no "
            "closed form. Use a model without that feature, or simulate the campaign with other "
            "sensors."
        )
