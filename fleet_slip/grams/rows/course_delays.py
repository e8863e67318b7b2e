"""How late the course of each car is, and which Gram rows were computed with another delay.

The delay is a whole number of parts of a tick, a pure function of the Gram rows of the set `delay`:
the same drives in any order give the same rows, and forgotten ones leave nothing.
"""

from collections.abc import Iterator, Mapping

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.car_numbers import DELAY
from fleet_slip.catalogue.course_change import COURSE_LATE, LATE_PARTS, MOST_EARLY, MOST_LATE
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.catalogue.sources import RECEIVED_FILES
from fleet_slip.delta import Snapshot
from fleet_slip.grams.rows.receiver_delay import RECEIVER, ReceiverDelay, receiver_delays

GRAIN_S = float(SAMPLE_TIME_S) / LATE_PARTS
"""What a delay is a whole number of, s."""
_OF_DELAY = ("file", "day", "vehicle_id", "drive_id", "signals", "n", "sums", "products")


def course_delays(grams: Snapshot, active: frozenset[str]) -> dict[str, int]:
    """Return each car's course delay in parts of a tick, of Gram rows of the `active` log files."""
    told = receiver_delays(_of_delay(grams, active)).cars
    return {car: in_parts(one) for car, one in told.items()}


def in_parts(one: ReceiverDelay) -> int:
    """Return a delay as Gram rows are corrected by it."""
    least, most = LATE_PARTS * MOST_EARLY, LATE_PARTS * MOST_LATE
    return min(max(round(one.value / GRAIN_S), least), most)


def _of_delay(grams: Snapshot, active: frozenset[str]) -> Iterator[pa.RecordBatch]:
    identity = features().identity(DELAY)
    for rows in _rows_of(grams, identity, *_OF_DELAY, RECEIVER):
        files = rows["file"].cast(pa.string())
        counts = pc.is_in(files, pa.array(sorted(active), pa.string()))
        counts = pc.or_(counts, pc.starts_with(files, RECEIVED_FILES))
        yield from rows.filter(counts).to_batches()


def files_of_other_delay(grams: Snapshot, identity: str, late: Mapping[str, int]) -> set[str]:
    """Return the log files that have Gram rows of a set with another delay than their cars have."""
    return {
        name
        for name, car, told in _recorded(grams, identity)
        if told != late.get(car, 0) and not name.startswith(RECEIVED_FILES)
    }


def recorded_cars(grams: Snapshot, identity: str, log_file: str) -> dict[str, int]:
    """Return the delays that the Gram rows of a set of one log file were corrected by, by car."""
    return {
        car: told for name, car, told in _recorded(grams, identity) if name == log_file and told
    }


def _recorded(grams: Snapshot, identity: str) -> set[tuple[str, str, int]]:
    """Return each log file, car and delay that Gram rows of a set are of; 0 where none was told."""
    found: set[tuple[str, str, int]] = set()
    for rows in _rows_of(grams, identity, "file", "vehicle_id", COURSE_LATE):
        files, cars, told = (rows[name].to_pylist() for name in ("file", "vehicle_id", COURSE_LATE))
        found.update(zip(files, cars, (late or 0 for late in told), strict=True))
    return found


def _rows_of(grams: Snapshot, identity: str, *columns: str) -> Iterator[pa.Table]:
    """Yield the Gram rows of a feature set, file by file; null in columns that came later."""
    for file in grams.files:
        mine = pc.equal(grams.table.read(file.path, ["feature_set"])["feature_set"], identity)
        if not pc.any(mine).as_py():
            continue
        there = grams.table.read_metadata(file.path).schema.to_arrow_schema().names
        rows = grams.table.read(file.path, [name for name in columns if name in there])
        for name in sorted(set(columns).difference(there)):
            rows = rows.append_column(name, pa.nulls(len(rows)))
        yield rows.filter(mine)
