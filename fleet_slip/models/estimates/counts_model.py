"""A published model as one of counts, so that Gram rows can tell its error."""

from fractions import Fraction

from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.models.manifest import Manifest
from fleet_slip.regression.exact.least_squares import LinearModel


def counts_model(manifest: Manifest, feature_set: str | None = None) -> LinearModel:
    """Return a published model as one of counts, exactly.

    For the Gram rows of a feature set of changes it has no intercept, and no column that is a
    number of the car alone: a change has none.
    """
    changes = feature_set is not None and features().feature_set(feature_set).change_ticks
    # Of the counts as they are now: a signal's scale may have changed since it was published.
    manifest.require_same_counts()
    scales = input_scales()
    unit = scales[manifest.label.signal]
    terms = [term for term in manifest.terms if not (changes and term.alone)]
    return LinearModel(
        tuple(term.signal for term in terms),
        manifest.label.signal,
        tuple(
            term.coefficient_exact
            * (scales[term.signal] if term.logged else term.scale_exact)
            / unit
            for term in terms
        ),
        Fraction(0) if changes else manifest.intercept_exact / unit,
    )
