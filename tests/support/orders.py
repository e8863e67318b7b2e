"""What workers do in the tests: a function that tells what it did, by files."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Order:
    """One task: it leaves a file with the number of its process, waits, and gives its name back."""

    name: str
    folder: Path
    seconds: float = 0.0
    deadly: bool = False

    @property
    def started_in(self) -> list[int]:
        """Processes that began it."""
        return [int(f.suffix[1:]) for f in self.folder.glob(f"{self.name}.*")]


def obey(order: Order) -> str:
    (order.folder / f"{order.name}.{os.getpid()}").touch()
    if order.deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(order.seconds)
    return order.name.upper()
