"""A published model as one of counts, so that Gram rows can tell its error."""

from fleet_slip.catalogue.features import input_scales
from fleet_slip.models.manifest import Manifest
from fleet_slip.regression.exact.least_squares import LinearModel


def counts_model(manifest: Manifest) -> LinearModel:
    """Return a published model as one of counts, exactly."""
    # Of the counts as they are now: a signal's scale may have changed since it was published.
    manifest.require_same_counts()
    scales = input_scales()
    unit = scales[manifest.label.signal]
    return LinearModel(
        manifest.signals,
        manifest.label.signal,
        tuple(
            term.coefficient_exact
            * (scales[term.signal] if term.logged else term.scale_exact)
            / unit
            for term in manifest.terms
        ),
        manifest.intercept_exact / unit,
    )
