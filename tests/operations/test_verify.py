"""Verification: whatever is damaged is found and named; what can be rebuilt is, and no more."""

import json
import os
import random
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.api.fleet_maintenance import FleetMaintenance
from fleet_slip.errors import QuestionError, StorageError
from fleet_slip.grams.update import update_grams
from fleet_slip.models.registry import CHAMPION, Registry
from fleet_slip.operations import verify as verification
from fleet_slip.operations.forget import forget
from fleet_slip.operations.rewriting import compact, vacuum
from fleet_slip.operations.status import status_of
from fleet_slip.operations.verify import check_grams, repair, verify
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change
from fleet_slip.warehouse.erasure_log import ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.commands import RunCommand
from tests.support.logs import DAY, land, log_rows, path_of, random_counts
from tests.support.manifests import manifest, publish
from tests.support.once import filled_once


@pytest.fixture
@filled_once
def filled(warehouse: Warehouse) -> None:
    """Two log files, their Gram rows, and a document."""
    rng = np.random.default_rng(0)
    for name in "ab":
        land(warehouse, name, log_rows(name, random_counts(rng, 300)))
    update_grams(warehouse)
    DocumentFolder(warehouse.root, "evaluations").append({"drive": "ä", "values": [1, 2.5]})


def flip(file: Path, bit: int) -> None:
    content = bytearray(file.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)


def damaged(warehouse: Warehouse) -> set[tuple[str, str]]:
    return {(finding.kind, finding.path) for finding in verify(warehouse, full=True).damage}


def test_nothing_is_found_where_nothing_is_wrong(filled: Warehouse) -> None:
    report = verify(filled, full=True)
    assert report.findings == []
    assert (report.files, report.log_files_recomputed, report.documents) == (3, 2, 1)


def test_progress_counts_what_is_done_in_each_step(filled: Warehouse) -> None:
    """A bar at 100 % while Gram rows are computed is wrong."""
    steps: dict[str, list[tuple[int, int]]] = {}
    FleetMaintenance(filled).verify(
        grams=True, progress=lambda name, *done: steps.setdefault(name, []).append(done)
    )
    assert steps.pop("compute Gram rows") == steps.pop("compare Gram rows") == [(1, 2), (2, 2)]
    for counts in steps.values():  # bytes of the tables
        assert counts == sorted(counts)
        assert counts[-1][0] == counts[-1][1]
    assert {*steps} == {"read logs", "read grams"}


def test_a_folder_without_a_warehouse_is_not_called_sound(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="nothing to verify"):
        verify(Warehouse(LocalFolder(tmp_path)))
    with pytest.raises(StorageError, match="no data root"):
        verify(Warehouse(LocalFolder(tmp_path / "absent")))


def test_logs_that_are_gone_are_found_and_nothing_follows_them(filled: Warehouse) -> None:
    paths = [Path(path) for path in filled.logs.snapshot().paths]
    rows = filled.grams.snapshot().rows
    shutil.rmtree(path_of(filled.root) / "logs" / "_delta_log")
    for path in paths:
        os.utime(path, (0, 0))
    assert ("log", "logs") in damaged(filled)
    assert vacuum(filled).files == ()
    assert all(path.exists() for path in paths)
    with pytest.raises(StorageError, match="are gone"):
        update_grams(filled)
    assert filled.grams.snapshot().rows == rows


def test_every_flipped_bit_is_found(filled: Warehouse) -> None:
    rng = random.Random(0)  # noqa: S311
    files = [Path(path) for table in filled.tables for path in table.snapshot().paths]
    files += sorted(path_of(filled.root).glob("evaluations/*.json"))
    for _ in range(12):
        bits = {file: rng.randrange(file.stat().st_size * 8) for file in files}
        for file, bit in bits.items():
            flip(file, bit)
        damaged = {finding.path for finding in verify(filled).damage}
        assert damaged >= {str(file.relative_to(path_of(filled.root))) for file in files}, bits
        for file, bit in bits.items():
            flip(file, bit)
    assert not verify(filled).damage


@pytest.mark.parametrize(
    ("harm", "problem"),
    [
        (lambda file: file.unlink(), "No such file"),
        (lambda file: file.write_bytes(b""), "has 0 bytes instead of"),
        (lambda file: file.write_bytes(file.read_bytes()[:-1]), "bytes instead of"),
        (lambda file: file.write_bytes(b"x" * file.stat().st_size), "do not match the checksum"),
    ],
)
def test_a_harmed_file_is_named_with_what_is_wrong(
    filled: Warehouse, harm: Callable[[Path], object], problem: str
) -> None:
    file = Path(filled.logs.snapshot().paths[0])
    harm(file)
    (finding,) = verify(filled).damage
    assert finding.path == str(file.relative_to(path_of(filled.root)))
    assert problem in finding.problem


def test_a_log_of_the_table_that_tells_other_counts_is_found(filled: Warehouse) -> None:
    log = max(path_of(filled.root).glob("logs/_delta_log/*.json"))
    log.write_text(log.read_text().replace('numRecords\\": 300', 'numRecords\\": 301'))
    (in_log, in_file) = verify(filled).damage
    assert "does not match the checksum" in in_log.problem
    assert "has 300 rows, the Delta log says 301" in in_file.problem
    log.write_text(log.read_text()[:-20])
    assert ("log", "logs") in damaged(filled)


def test_a_flipped_bit_in_the_key_of_a_unit_of_work_is_damage_not_a_bug(filled: Warehouse) -> None:
    log = max(path_of(filled.root).glob("logs/_delta_log/*.json"))
    flip(log, 8 * (log.read_bytes().index(b'"appId"') + 1))
    assert "log" in {kind for kind, _ in damaged(filled)}


def test_a_drive_in_two_files_or_without_a_beginning_is_found(filled: Warehouse) -> None:
    rng = np.random.default_rng(1)
    land(filled, "twice", log_rows("a", random_counts(rng, 5)))
    land(filled, "headless", log_rows("c", random_counts(rng, 5)).slice(1))
    assert {path for kind, path in damaged(filled) if kind == "drive"} == {"a", "c"}


def test_a_wrong_gram_row_is_found_and_rebuilt(filled: Warehouse) -> None:
    snapshot = filled.grams.snapshot()
    rows = pa.parquet.read_table(snapshot.paths[0])
    wrong = rows.set_column(rows.schema.get_field_index("n"), "n", pa.array([300, 299]))
    action = filled.grams.write_file("signals-wrong", wrong)
    snapshot.commit(Change(add=[action], remove=snapshot.files))
    report = verify(filled, full=True)
    assert [finding.kind for finding in report.damage] == ["gram"]
    repair(filled, report)
    assert {finding.kind for finding in verify(filled, full=True).findings} == {"unreferenced"}
    assert not damaged(filled)


def test_a_gram_row_that_stands_twice_is_found_and_rebuilt(filled: Warehouse) -> None:
    rows = pa.parquet.read_table(filled.grams.snapshot().paths[0]).slice(0, 1)
    action = filled.grams.write_file("signals-twice", rows)
    filled.grams.snapshot().commit(Change(add=[action]))
    report = verify(filled)
    assert ["is stored 2 times" in finding.problem for finding in report.damage] == [True]
    repair(filled, report)
    assert not damaged(filled)


def test_an_unknown_log_file_is_told_and_never_deleted(filled: Warehouse) -> None:
    file = Path(filled.logs.snapshot().paths[0])
    flip(file, 99)
    before = file.read_bytes()
    assert repair(filled, verify(filled)) == []
    assert file.read_bytes() == before
    assert damaged(filled) == {("file", str(file.relative_to(path_of(filled.root))))}


def test_a_log_file_lost_with_its_gram_rows_is_told_and_the_rest_rebuilt(
    filled: Warehouse, run_command: RunCommand
) -> None:
    lost, *remaining = filled.logs.snapshot().paths
    assert remaining
    content = Path(lost).read_bytes()
    Path(lost).unlink()
    for gram in filled.grams.snapshot().paths:
        Path(gram).unlink()
    repair = run_command("verify", "--repair", "--json")
    assert repair.exit_code == 9
    (damage,) = repair.json["damage"]
    assert damage["path"] == str(Path(lost).relative_to(path_of(filled.root)))
    assert damage["problem"].endswith("rows)")
    rows = [filled.grams.read(f.path, ["file"]) for f in filled.grams.snapshot().files]
    assert {name for part in rows for name in part["file"].to_pylist()} == {
        str(Path(other).relative_to(path_of(filled.logs.folder))) for other in remaining
    }
    Path(lost).write_bytes(content)
    assert run_command("verify", "--repair").exit_code == 0
    assert not damaged(filled)


def test_a_document_is_checked_to_the_last_byte(filled: Warehouse) -> None:
    folder = DocumentFolder(filled.root, "models/m/history")
    for number in range(3):
        folder.append({"number": number})
    (path_of(folder.folder) / "2.json").unlink()
    text = (path_of(folder.folder) / "3.json").read_text()
    (path_of(folder.folder) / "3.json").write_text(json.dumps(json.loads(text)))
    assert damaged(filled) == {
        ("document", "models/m/history/2.json"),
        ("document", "models/m/history/3.json"),
    }


@pytest.fixture
@filled_once
def decided(warehouse: Warehouse) -> None:
    """Logs, an erased car, and a pinned model of two versions."""
    rng = np.random.default_rng(0)
    for car in "ab":
        land(warehouse, car, log_rows(car, random_counts(rng, 30), vehicle_id=f"car-{car}"))
    forget(warehouse, ErasureSubject("vehicle", "car-b"))
    registry = Registry.open(warehouse)
    for number in (1, 2):
        publish(registry, manifest(Fraction(number)))
    registry.hold("sideslip", CHAMPION, "pin")


@pytest.mark.parametrize(
    ("lost", "command"),
    [
        ("forgotten/1.json", ("forget", "--vehicle", "car-a")),
        ("forgotten/2.json", ("forget", "--vehicle", "car-a")),
        ("models/sideslip/history/1.json", ("show", "sideslip")),
        ("models/sideslip/history/3.json", ("show", "sideslip")),
        ("models/sideslip/versions/2.json", ("models",)),
    ],
)
def test_a_lost_decision_stops_commands_until_its_loss_is_accepted(
    decided: Warehouse, run_command: RunCommand, lost: str, command: tuple[str, ...]
) -> None:
    (path_of(decided.root) / lost).unlink()
    refused = run_command(*command)
    assert refused.exit_code == StorageError.exit_code
    assert f"{lost}: the document was written and is missing. Restore" in refused.stderr
    assert any(lost in problem for problem in status_of(decided).problems)
    assert ("document", lost) in damaged(decided)
    repair(decided, verify(decided))
    assert ("document", lost) in damaged(decided)
    accepted = run_command("verify", "--accept-loss", lost)
    assert f"accepted the loss of {lost}" in accepted.stdout + accepted.stderr
    assert ("document", lost) not in damaged(decided)
    assert run_command(*command).exit_code != StorageError.exit_code


def test_an_accepted_loss_names_a_lost_document(
    decided: Warehouse, run_command: RunCommand
) -> None:
    answer = run_command("verify", "--accept-loss", "forgotten/1.json")
    assert answer.exit_code == QuestionError.exit_code
    assert "no document is missing" in answer.stderr


def test_leftovers_and_a_backlog_are_remarks(filled: Warehouse) -> None:
    filled.logs.write_file("left", log_rows("d", random_counts(np.random.default_rng(3), 5)), DAY)
    land(filled, "new", log_rows("e", random_counts(np.random.default_rng(3), 5)))
    report = verify(filled)
    assert not report.damage
    assert [finding.kind for finding in report.findings] == ["backlog", "unreferenced"]


@pytest.fixture
@filled_once
def three(warehouse: Warehouse) -> None:
    """Three log files of two cars."""
    rng = np.random.default_rng(0)
    for number in range(3):
        drive = log_rows(f"d{number}", random_counts(rng, 30), vehicle_id=f"car-{number % 2}")
        land(warehouse, f"f{number}", drive)
    update_grams(warehouse)


def compact_and_vacuum(warehouse: Warehouse) -> None:
    compact(warehouse)
    vacuum(warehouse, retention_hours=0)


def forget_now(warehouse: Warehouse) -> None:
    forget(warehouse, ErasureSubject("vehicle", "car-1"), now=True)


JOBS = pytest.mark.parametrize(
    "job", [forget_now, pytest.param(compact_and_vacuum, marks=pytest.mark.long)]
)


@pytest.fixture
def meanwhile(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Does something, once or every time, when a function of a module is called."""

    def patch(module: Any, name: str, act: Callable[[], Any], *, once: bool = True) -> None:
        real = getattr(module, name)

        def overtaken(*arguments: Any, **named: Any) -> Any:
            if once:
                monkeypatch.setattr(module, name, real)
            act()
            return real(*arguments, **named)

        monkeypatch.setattr(module, name, overtaken)

    return patch


@JOBS
@pytest.mark.parametrize("moment", ["by_sql", "stored_grams", "by_kernel"])
def test_a_check_beside_a_job_that_takes_files_away_finds_no_damage(
    job: Callable[[Warehouse], Any], moment: str, three: Warehouse, meanwhile: Callable[..., None]
) -> None:
    meanwhile(verification, moment, lambda: job(three))
    assert check_grams(three, 3).drives >= 2


@JOBS
@pytest.mark.parametrize("moment", ["verify_files", "verify_rows", "verify_grams"])
def test_a_verification_beside_a_job_that_takes_files_away_finds_no_damage(
    job: Callable[[Warehouse], Any], moment: str, three: Warehouse, meanwhile: Callable[..., None]
) -> None:
    meanwhile(verification, moment, lambda: job(three))
    assert not verify(three, full=True).damage


def test_damage_is_damage_beside_other_jobs_too(
    three: Warehouse, meanwhile: Callable[..., None]
) -> None:
    removed, *_ = three.logs.snapshot().files
    (path_of(three.logs.folder) / removed.path).unlink()
    rng = np.random.default_rng(1)
    meanwhile(
        verification,
        "by_kernel",
        lambda: land(three, "more", log_rows("x", random_counts(rng, 9))),
    )
    with pytest.raises(StorageError, match=removed.path.rpartition("/")[2]):
        check_grams(three, 3)
    assert {finding.kind for finding in verify(three).damage} >= {"file"}


def test_a_check_of_tables_that_never_rest_ends(
    three: Warehouse, meanwhile: Callable[..., None]
) -> None:
    def spoil() -> None:
        three.grams.fence()
        raise StorageError("a file is gone")

    meanwhile(verification, "by_kernel", spoil, once=False)
    with pytest.raises(StorageError, match="a file is gone"):
        check_grams(three, 3)
