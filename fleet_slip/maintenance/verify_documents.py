"""Compares documents with their checksums, and model versions with the tables they were made of."""

from fleet_slip.delta import Snapshot
from fleet_slip.errors import DataError, FleetSlipError, QuestionError, RefusedError, StorageError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder, StoredFile
from fleet_slip.maintenance.verification import Damage, Verification
from fleet_slip.models.trained_drives import read_trained_drives
from fleet_slip.models.versions import Registry
from fleet_slip.runs.anchors import find_missing_documents
from fleet_slip.runs.records import find_changed_lines
from fleet_slip.warehouse.tables import Warehouse


def verify_documents(root: Folder, report: Verification) -> None:
    """Look for documents and lines of the history that were changed, and documents gone."""
    for folder in _document_folders(root):
        report.documents += len(folder.numbers())
        for file, problem in folder.faults().items():
            report.findings.append(Damage("document", file.removeprefix(f"{root}/"), problem))
    for path, problem in find_missing_documents(root):
        report.findings.append(Damage("document", path, problem))
    for path, problem in find_changed_lines(root):
        report.findings.append(Damage("document", path, problem))


def _document_folders(root: Folder) -> list[DocumentFolder]:
    found: set[str] = set()
    for name in root.names():
        if not (root / name / "_delta_log").exists():
            files = (root / name).files()
            found.update(f"{name}/{f.path}".rpartition("/")[0] for f in files if _is_document(f))
    return [DocumentFolder(root / path) for path in sorted(found)]


def _is_document(file: StoredFile) -> bool:
    return file.path.endswith(".json")


def verify_models(
    warehouse: Warehouse, snapshots: dict[str, Snapshot], report: Verification
) -> None:
    """Look for versions that nothing present can have made, and aliases that point at nothing."""
    registry = Registry(warehouse.root / "models")
    for name in registry.names():
        numbers = registry.versions(name)
        for number in numbers:
            try:
                manifest = registry.load(name, number).manifest
                read_trained_drives(registry.folder_of(name), manifest)
            except RefusedError as error:  # its signature
                report.findings.append(Damage("model", f"{name}@{number}", str(error)))
                continue
            except (StorageError, DataError, QuestionError) as error:
                if "drives-" in str(error):  # anything else is told as a document
                    report.findings.append(Damage("model", f"{name}@{number}", str(error)))
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
                    report.findings.append(Damage("model", f"{name}@{number}", problem))
        try:
            aliases = registry.history(name).aliases()
        except (FleetSlipError, ValueError):
            continue
        for alias, version in aliases.items():
            if version not in numbers:
                problem = f"points at version {version}, which does not exist"
                report.findings.append(Damage("model", f"{name}@{alias}", problem))
