"""Tells how far a log is read, for whoever shows it."""

from fleet_slip.progress import Progress, no_progress


class Meter:
    """A share of a log's bytes: that of its rows which were read.

    Where all of a file must be passed over before its first row, as with messages in the order of
    time, each pass counts for half of what is left.
    """

    def __init__(self, size: int = 0, progress: Progress = no_progress) -> None:
        """Take the bytes of the log, and who is told how many more of them are done."""
        self._size, self._progress, self.is_watched = size, progress, progress is not no_progress
        self._told = self._at = self._rows = 0
        self._share = self._begun = 0.0

    def pass_over(self, at: int, size: int) -> None:
        """Tell how much of a file was passed over; at an earlier place another pass has begun."""
        if at < self._at:
            self._begun = self._share
        self._at = at
        self._tell(self._begun + (1 - self._begun) / 2 * at / max(size, 1))

    def expect(self, rows: int, of: int = 0) -> None:
        """Take about how many rows come, or come of so many bytes; 0 where that is not known."""
        self._rows = rows * self._size // of if of else rows
        self._begun = self._share

    def count(self, rows: int) -> None:
        """Tell how many rows were read so far."""
        if self._rows:
            self._tell(self._begun + (1 - self._begun) * rows / self._rows)

    def end(self) -> None:
        """Tell that all was read."""
        self._tell(1.0)

    def _tell(self, share: float) -> None:
        self._share = max(self._share, min(share, 1.0))
        done = int(self._size * self._share)
        if done > self._told:
            self._progress(done - self._told, self._size)
            self._told = done
