"""Looks for names of what was forgotten, by their salted hashes, wherever names of drives stand."""

from collections.abc import Collection, Iterator, Mapping, Sequence

from fleet_slip.maintenance.verification import Damage, Verification
from fleet_slip.maintenance.verify_files import ReadFile
from fleet_slip.warehouse.audit import Audit
from fleet_slip.warehouse.cleared_cars import ClearedCars
from fleet_slip.warehouse.tables import Warehouse
from fleet_slip.words import number_of


def verify_names(
    warehouse: Warehouse, read: Mapping[str, Sequence[ReadFile]], report: Verification, full: bool
) -> None:
    """Look for forgotten cars, and for forgotten drives too with `full`: 40 ms for each name.

    Names in a dictionary that no row of the file has are few, and all compared.
    """
    unused = frozenset(name for one in _all(read) for name in _unused(one))
    cars, drives = (_used(_all(read), column) for column in ("vehicle_id", "drive_id"))
    audit = Audit(warehouse.root)
    if (cleared := ClearedCars(warehouse.root).read()) and cleared.entries >= audit.begun():
        cars -= cleared.names
    barred = audit.barred(cars | unused, (drives if full else frozenset()) | unused, ended=True)
    wrong = {"vehicle_id": barred.vehicles, "drive_id": barred.drives}
    for table, files in read.items():
        for one in files:
            if any(not wrong[name].isdisjoint(_used([one], name)) for name in wrong):
                problem = "has rows of a car or drive that was forgotten; give forget again"
            elif not (barred.vehicles | barred.drives).isdisjoint(_unused(one)):
                problem = (
                    "has the name of a car or drive that was forgotten; run: fleet-slip migrate"
                )
            else:
                continue
            report.findings.append(Damage("name", f"{table}/{one.file.path}", problem))
        if many := sum(bool(_unused(one)) for one in files):
            problem = (
                f"{number_of(many, 'file')} with names that no row has; run: fleet-slip migrate"
            )
            report.findings.append(Damage("backlog", table, problem))


def _all(read: Mapping[str, Sequence[ReadFile]]) -> Iterator[ReadFile]:
    return (one for files in read.values() for one in files)


def _unused(one: ReadFile) -> frozenset[str]:
    return frozenset().union(*(names.unused for names in one.names.values()))


def _used(files: Collection[ReadFile] | Iterator[ReadFile], column: str) -> frozenset[str]:
    return frozenset().union(*(one.names[column].used for one in files if column in one.names))
