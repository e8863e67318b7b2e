"""Makes the integer program of a published manifest."""

from decimal import Decimal

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.definitions import plain_column
from fleet_slip.catalogue.signals import COUNT_MAX, catalogue
from fleet_slip.columns.lowering import Lowering
from fleet_slip.columns.operations import size_of
from fleet_slip.errors import DataError
from fleet_slip.export.fixed_point import LARGEST_ANGLE, OUTPUT_COUNTS, fixed_point
from fleet_slip.export.program import Angle, Input, Program
from fleet_slip.models.estimates.counts_model import counts_model
from fleet_slip.models.manifest import Manifest


def compile_program(manifest: Manifest) -> Program:
    """Return what a published version computes.

    Raises what `write_program` raises, and `QuestionError` or `DataError` for definitions that
    contradict each other.
    """
    from fleet_slip.models.estimates.predictor import Predictor  # noqa: PLC0415 - numba, not for show

    _ = Predictor.of(manifest).plan.program  # raises for what the kernel could not compute
    return write_program(manifest)


def write_program(manifest: Manifest) -> Program:
    """Return the program of definitions that are known to agree.

    Raises `RefusedError` if counts mean something else now, or no bound of the error can be stated,
    and `DataError` for a feature of no signal.
    """
    signals = _inputs(manifest)
    columns = [term.definition or plain_column(term.signal, term.sql) for term in manifest.terms]
    lowered, places = Lowering.of([one.name for one in signals], columns)
    steps, facts, numbers = tuple(lowered.steps), tuple(lowered.facts), tuple(lowered.numbers)
    ranges = lowered.ranges([(one.min_count, one.max_count) for one in signals])
    exact = counts_model(manifest)
    fixed = fixed_point(
        exact.intercept * OUTPUT_COUNTS,
        [one * OUTPUT_COUNTS for one in exact.coefficients],
        [size_of(ranges[place]) for place in places],
    )
    label = catalogue()[manifest.label.signal]
    angle = Angle(
        name=manifest.label.signal,
        column=label.column,
        unit=label.unit,
        scale=label.scale / Decimal(OUTPUT_COUNTS),
        places=tuple(places),
        limit=LARGEST_ANGLE,
        **vars(fixed),
    )
    return Program(signals, facts, numbers, steps, angle)


def _inputs(manifest: Manifest) -> tuple[Input, ...]:
    used: set[str] = set()
    for term in manifest.terms:
        parts = term.definition.parts if term.definition else (term,)
        if any(part.sql and not parse(part.sql).inputs for part in parts):
            raise DataError(f"the feature {term.signal} is of no signal. Publish the model again.")
        used |= {*term.inputs}
    return tuple(
        # -32768 is a missing count on board, so that a cyclic signal lacks its half turn there.
        Input(name, s.column, s.unit, s.scale, max(s.min_count, -COUNT_MAX), s.max_count)
        for name, s in catalogue().signals.items()
        if name in used
    )
