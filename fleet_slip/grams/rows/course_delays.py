"""By how much the course of each car is late, and which Gram rows were computed otherwise.

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
from fleet_slip.delta import Snapshot, TableFile
from fleet_slip.grams.rows.receiver_delay import ReceiverDelay, receiver_delays

GRAIN_S = float(SAMPLE_TIME_S) / LATE_PARTS
"""What a delay is a whole number of, s."""


def course_delays(grams: Snapshot, active: frozenset[str]) -> dict[str, int]:
    """Return each car's course delay in parts of a tick, of Gram rows of the `active` log files."""
    return {car: in_parts(one) for car, one in receiver_delays(_of_delay(grams, active)).items()}


def in_parts(one: ReceiverDelay) -> int:
    """Return a delay as Gram rows are corrected by it."""
    least, most = LATE_PARTS * MOST_EARLY, LATE_PARTS * MOST_LATE
    return min(max(round(one.value / GRAIN_S), least), most)


def _of_delay(grams: Snapshot, active: frozenset[str]) -> Iterator[pa.RecordBatch]:
    identity = features().identity(DELAY)
    wanted = ["feature_set", "file", "day", "vehicle_id", "drive_id", "signals", "n", "sums"]
    for file in _files_of(grams, identity):
        rows = grams.table.read(file.path, [*wanted, "products"])
        files = rows["file"].cast(pa.string())
        counts = pc.is_in(files, pa.array(sorted(active), pa.string()))
        counts = pc.or_(counts, pc.starts_with(files, RECEIVED_FILES))
        mine = pc.and_(pc.equal(rows["feature_set"], identity), counts)
        yield from rows.filter(mine).to_batches()


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
    for file in _files_of(grams, identity):
        there = COURSE_LATE in grams.table.read_metadata(file.path).schema.names
        wanted = ["feature_set", "file", "vehicle_id", *([COURSE_LATE] if there else [])]
        rows = grams.table.read(file.path, wanted)
        mine = rows.filter(pc.equal(rows["feature_set"], identity))
        told = mine[COURSE_LATE].fill_null(0).to_pylist() if there else [0] * len(mine)
        found.update(
            zip(mine["file"].to_pylist(), mine["vehicle_id"].to_pylist(), told, strict=True)
        )
    return found


def _files_of(grams: Snapshot, identity: str) -> Iterator[TableFile]:
    """Yield the files that have Gram rows of a feature set."""
    for file in grams.files:
        sets = grams.table.read(file.path, ["feature_set"])["feature_set"].unique()
        if identity in sets.to_pylist():
            yield file
