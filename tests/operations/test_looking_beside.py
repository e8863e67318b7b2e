"""`check` and `verify` beside jobs that take files away, which is no damage."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fleet_slip.errors import StorageError
from fleet_slip.grams import check
from fleet_slip.grams.check import check_grams
from fleet_slip.grams.job import update_grams
from fleet_slip.operations import verify as verification
from fleet_slip.operations.find_drives import vacuum
from fleet_slip.operations.forget import forget
from fleet_slip.operations.rewriting import compact
from fleet_slip.operations.verify import verify
from fleet_slip.warehouse.forgotten import Forgettable
from fleet_slip.warehouse.tables import Warehouse
from tests.support.logs import land, log_rows, path_of, random_counts


@pytest.fixture
def filled(warehouse: Warehouse) -> Warehouse:
    """Three log files of two cars."""
    rng = np.random.default_rng(0)
    for number in range(3):
        drive = log_rows(f"d{number}", random_counts(rng, 30), vehicle_id=f"car-{number % 2}")
        land(warehouse, f"f{number}", drive)
    update_grams(warehouse)
    return warehouse


def compact_and_vacuum(warehouse: Warehouse) -> None:
    compact(warehouse)
    vacuum(warehouse, retention_hours=0)


def forget_now(warehouse: Warehouse) -> None:
    forget(warehouse, Forgettable("vehicle", "car-1"), now=True)


@pytest.fixture
def meanwhile(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Does something, once or every time, when a function of a module is called."""

    def patch(module: Any, name: str, act: Callable[[], Any], *, once: bool = True) -> None:
        real = getattr(module, name)

        def overtaken(*given: Any, **named: Any) -> Any:
            if once:
                monkeypatch.setattr(module, name, real)
            act()
            return real(*given, **named)

        monkeypatch.setattr(module, name, overtaken)

    return patch


@pytest.mark.parametrize(
    "job",
    [
        forget_now,
        *(pytest.param(job, marks=pytest.mark.long) for job in (compact, compact_and_vacuum)),
    ],
)
@pytest.mark.parametrize("moment", ["find_gram_files", "by_sql", "stored_grams", "wide_grams"])
def test_a_check_beside_a_job_that_takes_files_away_finds_no_damage(
    job: Callable[[Warehouse], Any],
    moment: str,
    filled: Warehouse,
    meanwhile: Callable[..., None],
) -> None:
    meanwhile(check, moment, lambda: job(filled))
    assert check_grams(filled, 3).drives >= 2


@pytest.mark.parametrize(
    "job", [forget_now, pytest.param(compact_and_vacuum, marks=pytest.mark.long)]
)
@pytest.mark.parametrize("moment", ["verify_files", "verify_rows", "verify_grams"])
def test_a_verification_beside_a_job_that_takes_files_away_finds_no_damage(
    job: Callable[[Warehouse], Any],
    moment: str,
    filled: Warehouse,
    meanwhile: Callable[..., None],
) -> None:
    meanwhile(verification, moment, lambda: job(filled))
    assert not verify(filled, full=True).damage


def test_damage_is_damage_beside_other_jobs_too(
    filled: Warehouse, meanwhile: Callable[..., None]
) -> None:
    gone, *_ = filled.logs.snapshot().files
    (path_of(filled.logs.folder) / gone.path).unlink()
    rng = np.random.default_rng(1)
    meanwhile(
        check, "wide_grams", lambda: land(filled, "more", log_rows("x", random_counts(rng, 9)))
    )
    with pytest.raises(StorageError, match=gone.path.rpartition("/")[2]):
        check_grams(filled, 3)
    assert {finding.kind for finding in verify(filled).damage} >= {"file"}


def test_a_check_of_tables_that_never_rest_ends(
    filled: Warehouse, meanwhile: Callable[..., None]
) -> None:
    def spoil() -> None:
        filled.grams.fence()
        raise StorageError("a file is gone")

    meanwhile(check, "wide_grams", spoil, once=False)
    with pytest.raises(StorageError, match="a file is gone"):
        check_grams(filled, 3)
