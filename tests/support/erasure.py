"""Data roots whose cars are erased."""

import shutil
from datetime import date
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa

from fleet_slip.grams.update import update_grams
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.logs import land, log_rows, random_counts

CARS = ("alfa", "beta", "gamma")


def drive(car: str, number: int, day: date = date(2024, 5, 1)) -> pa.Table:
    rng = np.random.default_rng([CARS.index(car), number])
    counts = {name: (values // 8) for name, values in random_counts(rng, 200).items()}
    return log_rows(f"{car}-{number}", counts, day, vehicle_id=car)


def fill(root: Path, *cars: str) -> Warehouse:
    """A warehouse where some cars drove; files mix them."""
    shutil.copytree(_filled(cars).name, root, dirs_exist_ok=True)
    return Warehouse(LocalFolder(root))


@cache
def _filled(cars: tuple[str, ...]) -> TemporaryDirectory[str]:
    folder = TemporaryDirectory()
    warehouse = Warehouse(LocalFolder(Path(folder.name)))
    for number in range(3):
        land(warehouse, f"f{number}", *(drive(car, number) for car in cars))
    update_grams(warehouse)
    return folder


def mentions(root: Path, name: str) -> list[Path]:
    return [
        file for file in root.rglob("*") if file.is_file() and name.encode() in file.read_bytes()
    ]
