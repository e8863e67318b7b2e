"""Examines Gram rows in the table that cars sent: there is no log to compute them again from."""

from collections.abc import Iterator

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.received.plausible import find_impossible
from fleet_slip.grams.received.received_rows import is_received
from fleet_slip.grams.rows.gram_rows import by_signals, gram_table


def find_unsound(rows: pa.Table) -> Iterator[tuple[str, str]]:
    """Yield drives of received rows of the table `grams` that cannot be, and why.

    Each is examined as it was when it came, and its name must tell its car and its day.
    """
    came = rows.filter(is_received(rows))
    day = pc.strftime(pc.unique(came["day"]), "%Y%m%d") if len(came) else pa.array([])
    days = dict(zip(pc.unique(came["day"]).to_pylist(), day.to_pylist(), strict=True))
    identity = features().identity(PLAIN)
    columns = (came[name].to_pylist() for name in ("drive_id", "vehicle_id", "day", "feature_set"))
    for drive, vehicle, its_day, feature_set in zip(*columns, strict=True):
        if not str(drive).startswith(f"{vehicle}-{days[its_day]}T"):
            yield drive, "is of another car or day than its drive"
        if feature_set != identity:
            yield drive, "is of another feature set than the logged signals"
    for batch in came.combine_chunks().to_batches():
        for signals, some, _ in by_signals(batch):
            yield from _impossible(signals, some)


def _impossible(signals: str, rows: pa.RecordBatch) -> Iterator[tuple[str, str]]:
    drives = rows["drive_id"].to_pylist()
    names = signals.split(",") if signals else []
    known = catalogue()
    if not set(names) <= set(known.gram_signals):
        yield from ((drive, "has signals that there are not") for drive in drives)
        return
    if not names:
        return
    table = gram_table(signals, rows)
    ranges = [(known[name].min_count, known[name].max_count) for name in names]
    for reason, at in find_impossible(table.n, table.sums, table.products, ranges).items():
        yield from ((drives[one], reason) for one in at.tolist())
