"""Modules of the package that read the environment."""

import re
from pathlib import Path

import fleet_slip

PACKAGE = Path(fleet_slip.__file__).parent

READERS = {
    "cli/app.py": "the folder for fonts, which matplotlib needs before it is imported",
    "cli/main.py": "Arrow's allocator and pydantic's plugins, before they are imported",
    "cli/output.py": "TERM, CI",
    "warehouse/warehouse.py": "open_warehouse: the data root and the folder of configs",
    "resources.py": "the system's folder for caches, needed when a module is imported",
    "compiling.py": "numba's folder for caches, needed when a module is imported",
    "storage/objects.py": "AWS_ALLOW_HTTP, which stands beside the credentials of the libraries",
    "ingest/formats/reading.py": "what a child process inherits",
}


def test_no_other_module_reads_the_environment() -> None:
    modules = {
        file.relative_to(PACKAGE).as_posix()
        for file in PACKAGE.rglob("*.py")
        if re.search(r"\benviron\b|\bgetenv\b", file.read_text(encoding="utf-8"))
    }
    assert modules == {*READERS}
