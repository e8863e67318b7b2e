"""Which drives of a measured file follow each other so soon that they are one trip."""

from fleet_slip.catalogue.sources import LONGEST_PAUSE_S


class Trips:
    """Names each drive's trip: the first of the drives of one file that follow each other."""

    def __init__(self) -> None:
        """Begin without drives."""
        self._last: dict[int, tuple[str, float]] = {}

    def name(self, drive_id: str, group: int, start_s: float, end_s: float) -> str:
        """Return the trip of the next drive of a group of rows, in the order of the file.

        A clock that goes back begins another trip.
        """
        trip_id, ended_s = self._last.get(group, (drive_id, start_s))
        if not 0 <= start_s - ended_s <= LONGEST_PAUSE_S:
            trip_id = drive_id
        self._last[group] = trip_id, end_s
        return trip_id
