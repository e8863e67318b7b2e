"""Compares everything below a data root with everything else that tells what it must be.

Data files with the checksums in their names and the Delta log; drives with the rule that they are
whole; Gram rows with the logs by another path; documents with checksums; model versions with their
tables; names with the record of what was forgotten.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.delta import Snapshot, Table, TableFile, on_newest
from fleet_slip.delta.checkpoints import FOLDER as CHECKSUMS
from fleet_slip.delta.checkpoints import checkpoint_faults, checkpoints_without_checksum
from fleet_slip.delta.log_check import find_commit_faults
from fleet_slip.errors import DataError, FleetSlipError, QuestionError, RefusedError, StorageError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder, StoredFile
from fleet_slip.grams.rows.backlog import named_files
from fleet_slip.maintenance.vacuum import find_temporary_files, find_unreferenced
from fleet_slip.maintenance.verify_files import Verification, verify_files, verify_names
from fleet_slip.maintenance.verify_grams import SoundFiles, verify_drives, verify_grams
from fleet_slip.models.versions import Registry
from fleet_slip.progress import Progress, no_progress
from fleet_slip.runs.records import find_changed_lines, find_missing_documents
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of


def verify_documents(root: Folder, report: Verification) -> None:
    """Look for documents and lines of the history that were changed, and documents gone."""
    for folder in _document_folders(root):
        report.documents += len(folder.numbers())
        for file, problem in folder.faults().items():
            report.note("document", file.removeprefix(f"{root}/"), problem)
    for path, problem in find_missing_documents(root):
        report.note("document", path, problem)
    for path, problem in find_changed_lines(root):
        report.note("document", path, problem)


def _document_folders(root: Folder) -> list[DocumentFolder]:
    found: set[str] = set()
    for name in root.names():
        if not (root / name / "_delta_log").exists():
            files = (root / name).files()
            documents = (f"{name}/{f.path}" for f in files if f.path.endswith(".json"))
            found.update(path.rpartition("/")[0] for path in documents)
    return [DocumentFolder(root / path) for path in sorted(found)]


def verify_models(
    warehouse: Warehouse, snapshots: dict[str, Snapshot], report: Verification
) -> None:
    """Look for versions that nothing present can have made, and aliases that point at nothing."""
    registry = Registry.of(warehouse)
    for name in registry.names():
        numbers = registry.versions(name)
        for number in numbers:
            try:
                manifest = registry.load(name, number).manifest
                registry.require_drives(manifest)
            except RefusedError as error:  # its signature
                report.note("model", f"{name}@{number}", str(error))
                continue
            except (StorageError, DataError, QuestionError) as error:
                if "drives" in str(error):  # anything else is told as a document
                    report.note("model", f"{name}@{number}", str(error))
                continue
            trained = manifest.trained_on
            if manifest.imported_from is not None:  # the tables that made it are elsewhere
                continue
            made_of = {"grams": trained.grams_version}
            if trained.drives_without_log != trained.drives:
                made_of["logs"] = trained.logs_version
            for table, version in made_of.items():
                latest = snapshots[table].version if table in snapshots else None
                if latest is None or version > latest:
                    problem = f"was made of version {version} of {table}, which does not exist"
                    report.note("model", f"{name}@{number}", problem)
        try:
            aliases = registry.history(name).aliases()
        except (FleetSlipError, ValueError):
            continue
        for alias, version in aliases.items():
            if version not in numbers:
                problem = f"points at version {version}, which does not exist"
                report.note("model", f"{name}@{alias}", problem)


def verify(
    warehouse: Warehouse,
    *,
    full: bool = False,
    progress: Progress = no_progress,
    executor: Executor | None = None,
) -> Verification:
    """Verify a data root; `full` computes the Gram rows of all log files again.

    Workers of an executor, or threads, read; `progress` counts bytes. What jobs meanwhile take away
    is looked for again.
    """
    warehouse.require()
    look = partial(_verify, warehouse, full, progress, executor)
    return on_newest(warehouse.tables, look, lambda report: bool(report.damage))


def _verify(
    warehouse: Warehouse, full: bool, progress: Progress, executor: Executor | None
) -> Verification:
    report = Verification()
    snapshots = _open_tables(warehouse, report)
    read = {table: verify_files(s, report, progress, executor) for table, s in snapshots.items()}
    logs, grams = ([one.file for one in read.get(table, [])] for table in ("logs", "grams"))
    verify_names(warehouse, read, report, full)
    if logs:
        verify_drives(warehouse, logs, report)
    _report_missing_logs(snapshots, grams, report)
    if grams:
        active = {file.path for file in snapshots["logs"].files} if "logs" in snapshots else set()
        verify_grams(warehouse, SoundFiles(logs, grams, active), report, full, executor)
    verify_documents(warehouse.root, report)
    verify_models(warehouse, snapshots, report)
    _list_unreferenced(warehouse, snapshots, report)
    written = any(snapshot.version is not None for snapshot in snapshots.values())
    if not report.findings and not report.documents and not written:
        raise StorageError(
            f"{warehouse.root}: there is nothing to verify, neither tables nor models. Is it the "
            "right folder, and is its disk there? Choose another data root."
        )
    return report


def _open_tables(warehouse: Warehouse, report: Verification) -> dict[str, Snapshot]:
    found = {}
    for table in warehouse.tables:
        _verify_checkpoints(table, report)
        try:
            snapshot = table.unchecked_snapshot()
            _ = snapshot.files
        except FleetSlipError as error:
            report.note("log", table.folder.name, str(error))
        else:
            found[table.folder.name] = snapshot
            for file, problem in find_commit_faults(snapshot):
                path = f"{table.folder.name}/_delta_log/{file}"
                report.note("log", path, problem)
    return found


def _verify_checkpoints(table: Table, report: Verification) -> None:
    name = table.folder.name
    documents = DocumentFolder(table.folder / CHECKSUMS)
    report.documents += len(documents.numbers())
    if faults := documents.faults():
        for file, problem in faults.items():
            where = f"{name}/{CHECKSUMS}/{file.rpartition('/')[2]}"
            report.note("document", where, problem)
        return
    for checkpoint, problem in checkpoint_faults(table.folder):
        report.note("log", f"{name}/_delta_log/{checkpoint}", problem)
    for checkpoint in checkpoints_without_checksum(table.folder):
        problem = "no checksum was kept of this checkpoint; the next one comes with both"
        report.note("backlog", f"{name}/_delta_log/{checkpoint}", problem)


def _report_missing_logs(
    snapshots: Mapping[str, Snapshot], sound: Sequence[TableFile], report: Verification
) -> None:
    """Report a table of logs that is gone, as a folder that was not mounted is."""
    logs, grams = snapshots.get("logs"), snapshots.get("grams")
    if not logs or not grams or logs.version is not None:
        return
    damaged = frozenset(file.path for file in grams.files).difference(file.path for file in sound)
    if gone := named_files(replace(grams, without=damaged), PLAIN)[1]:
        problem = f"the table is gone that the Gram rows of {number_of(len(gone), 'file')} are of"
        report.note("log", "logs", problem)


def _list_unreferenced(
    warehouse: Warehouse, snapshots: dict[str, Snapshot], report: Verification
) -> None:
    for snapshot in snapshots.values():
        try:
            known, files = snapshot.removed(), find_unreferenced(snapshot.table)
        except StorageError:  # its log is damaged, as was told: it says of no file what that is
            continue
        for file in files:
            what = "replaced" if file.path in known else "never committed"
            then = "fleet-slip vacuum removes it in time"
            if snapshot.version is None:
                then = "if the table had a Delta log, restore that from a backup"
            _remark(warehouse, file, f"{what}; {then}", report)
    for file in find_temporary_files(warehouse):
        _remark(warehouse, file, "left by a killed job, or being written", report)


def _remark(warehouse: Warehouse, file: StoredFile, problem: str, report: Verification) -> None:
    where = str(file).removeprefix(f"{warehouse.root}/")
    report.note("unreferenced", where, problem)
