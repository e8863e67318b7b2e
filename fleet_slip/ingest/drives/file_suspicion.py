"""What looks wrong in a file as a whole: many rows refused, and times that are assumed."""

from collections.abc import Iterator, Mapping

from fleet_slip.ingest.drives.suspicion import Suspicion

LARGEST_REFUSED, FEWEST_REFUSED = 0.1, 10
_REFUSED = {
    "out_of_range": ("scaled", "Check its unit."),
    "not_a_number": ("texts", "Name those that mean no value under missing."),
    "not_finite": ("values", 'Write missing = ["nan"] if they mean no value.'),
}
_OF_TIME = ("time", "isolated", "too_short", "not_a_time")


def find_refusals(
    refused: Mapping[tuple[str, str], int], rows: int, others: Mapping[str, int] | None = None
) -> Iterator[Suspicion]:
    """Yield the signals of which more than a tenth of a file's rows were refused, by reason.

    `others` are the rows refused for anything but a signal, by reason: together they are another.
    """
    for (name, reason), count in refused.items():
        if count > max(rows * LARGEST_REFUSED, FEWEST_REFUSED):
            kind, remedy = _REFUSED.get(reason, ("values", "Look at the column."))
            figure = f"{count:,} of {rows:,} rows are refused for it, {reason}"
            yield Suspicion(kind, (name,), figure, remedy)
    total = sum((others or {}).values())
    if others and total > max(rows * LARGEST_REFUSED, FEWEST_REFUSED):
        reason = max(others, key=lambda one: others[one])
        figure = f"{total:,} of {rows:,} rows are refused, {others[reason]:,} as {reason}"
        if reason.startswith(_OF_TIME):
            remedy = "Check the column of times, its unit and its format"
            if reason in {"time_duplicate", "time_backwards"}:
                remedy += ", and map the column that tells cars or trips apart if there are several"
            yield Suspicion("values", ("time",), figure, f"{remedy}.")
        else:
            yield Suspicion("values", ("rows",), figure, "Look at the view quarantine.")


def assumed_rate(rate_hz: float | None) -> Iterator[Suspicion]:
    """Yield that a log has no times, and that its mapping assumes a rate; None: it does not."""
    if rate_hz is not None:
        figure = f"the log has no times, and {rate_hz:g} Hz are assumed"
        remedy = "Find out, correct rate_hz, and remove assumed = true."
        yield Suspicion("time", ("rate_hz",), figure, remedy)
