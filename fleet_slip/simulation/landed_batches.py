"""What a campaign lands in the logs, and whether it did: batches of drives, and complete days.

Units of work, their version made of what defines them: a changed campaign is noticed.
"""

from collections.abc import Iterable, Iterator
from datetime import date

from fleet_slip.delta import Snapshot, Unit
from fleet_slip.errors import RefusedError
from fleet_slip.simulation.campaign import Batch, Campaign


def has_landed(snapshot: Snapshot, batch: Batch) -> bool:
    """Whether a batch is in the logs. Raises `RefusedError` if another batch has its place."""
    landed = snapshot.landed(unit_name(batch.campaign, batch.day, batch.index))
    if landed is not None and landed != unit_of(batch).version:
        raise changed_campaign(batch.campaign, batch.day)
    return landed is not None


def changed_campaign(campaign: str, day: date) -> RefusedError:
    """Return the error that a day's batches, or the day, landed as something else."""
    return RefusedError(
        f"{day}: the campaign {campaign!r} was changed since this day was simulated, and logs are "
        "never replaced. Give the changed campaign another name, or use another data root."
    )


def unit_of(batch: Batch) -> Unit:
    """Return the unit of work that lands a batch; its version is from the batch's content."""
    name = unit_name(batch.campaign, batch.day, batch.index)
    return Unit(name, int(batch.digest[:15], base=16))


def unit_name(campaign: str, day: date, index: int) -> str:
    """Return the name of the unit of work that lands a day's batch of an index."""
    return f"simulate/{campaign}/{day}/{index}"


def file_name(batch: Batch) -> str:
    """Return the name of a batch's file, before the checksum of its bytes."""
    return f"{batch.campaign}-{batch.index:04d}-{batch.digest[:12]}"


def day_units(campaign: Campaign, days: Iterable[date]) -> Iterator[tuple[Unit, date]]:
    """Yield the unit of work that records that a day is complete, for each of some days."""
    version = int(campaign.digest[:15], base=16)
    return ((Unit(f"simulate/{campaign.name}/{day}", version), day) for day in days)
