"""Writes what is missing of a campaign into the warehouse.

Each batch of drives is one file and one unit of work that lands exactly once: a repeated or
interrupted job goes on with the batches that have not landed.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass
from datetime import date
from itertools import islice

from deltalake.transaction import AddAction

from fleet_slip.campaign import Batch, Campaign
from fleet_slip.errors import RefusedError
from fleet_slip.simulate import simulate_batch
from fleet_slip.storage import Change, Snapshot, Unit, retried
from fleet_slip.warehouse import Warehouse

IN_FLIGHT = 4
"""Batches that may be under way or done and not yet committed: bounds memory and lost work."""

Progress = Callable[[int, int], None]
"""Called with rows landed since the last call, and rows expected in all."""


@dataclass(frozen=True)
class SimulationReport:
    """What a run of the job did."""

    batches_written: int
    batches_present: int
    drives: int
    rows: int
    size_bytes: int
    logs_version: int | None

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        return bool(self.batches_written)


@dataclass(frozen=True)
class _Written:
    batch: Batch
    action: AddAction
    rows: int


def simulate_campaign(
    warehouse: Warehouse,
    campaign: Campaign,
    days: Iterable[date],
    executor: Executor,
    progress: Progress = lambda _rows, _all: None,
) -> SimulationReport:
    """Simulate what has not landed of the given days of a campaign; see `simulate_batches`."""
    batches = [batch for day in days for batch in campaign.batches(day)]
    return simulate_batches(warehouse, batches, executor, progress)


def simulate_batches(
    warehouse: Warehouse,
    batches: Sequence[Batch],
    executor: Executor,
    progress: Progress = lambda _rows, _all: None,
) -> SimulationReport:
    """Simulate the batches that have not landed, and land each.

    Raises `RefusedError` if a batch's place was taken by a different version of it, and
    `StorageError` if the warehouse cannot be written.
    """
    snapshot = warehouse.logs.snapshot()
    missing = [batch for batch in batches if not has_landed(snapshot, batch)]
    expected = sum(drive.expected_rows for batch in missing for drive in batch.drives)
    progress(0, expected)
    written: list[_Written] = []
    for result in _in_flight(warehouse, missing, executor):
        if _land(warehouse, result):
            written.append(result)
        progress(result.rows, expected)
    return SimulationReport(
        batches_written=len(written),
        batches_present=len(batches) - len(missing),
        drives=sum(len(result.batch.drives) for result in written),
        rows=sum(result.rows for result in written),
        size_bytes=sum(result.action.size for result in written),
        logs_version=warehouse.logs.snapshot().version,
    )


def has_landed(snapshot: Snapshot, batch: Batch) -> bool:
    """Whether a batch is in the logs. Raises `RefusedError` if another batch has its place."""
    unit = unit_of(batch)
    landed = snapshot.landed(unit.name)
    if landed is not None and landed != unit.version:
        raise RefusedError(
            f"{batch.day}: the campaign {batch.campaign!r} was changed since this day was "
            "simulated, and logs are never replaced. Give the changed campaign another name, or "
            "use another --root."
        )
    return landed is not None


def unit_of(batch: Batch) -> Unit:
    """Return the unit of work that lands a batch; its version is from the batch's content."""
    return Unit(
        f"simulate/{batch.campaign}/{batch.day}/{batch.index}", int(batch.digest[:15], base=16)
    )


def _in_flight(
    warehouse: Warehouse, batches: Iterable[Batch], executor: Executor
) -> Iterator[_Written]:
    """Yield batches as they are written, with a bounded number under way."""
    waiting = iter(batches)
    running: set[Future[_Written]] = set()
    try:
        while True:
            for batch in islice(waiting, IN_FLIGHT - len(running)):
                running.add(executor.submit(_write, warehouse, batch))
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    finally:
        for future in running:
            future.cancel()


def _write(warehouse: Warehouse, batch: Batch) -> _Written:
    rows = simulate_batch(batch)
    action = warehouse.logs.write_file(file_name(batch), rows, batch.day)
    return _Written(batch, action, rows.num_rows)


def file_name(batch: Batch) -> str:
    """Return the name of a batch's file, before the checksum of its bytes."""
    return f"{batch.campaign}-{batch.index:04d}-{batch.digest[:12]}"


def _land(warehouse: Warehouse, written: _Written) -> bool:
    """Commit a batch; False if another process landed it first."""
    change = Change(
        add=[written.action],
        units=[unit_of(written.batch)],
        note={
            "job": "simulate",
            "campaign": written.batch.campaign,
            "digest": written.batch.digest,
        },
    )

    def attempt() -> bool:
        snapshot = warehouse.logs.snapshot()
        if has_landed(snapshot, written.batch):
            return False
        snapshot.commit(change)
        return True

    return retried(attempt)
