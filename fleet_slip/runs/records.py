"""Lines of the history of runs, each with its own checksum, and what is wrong with a line.

    {"run_id":…,"documents":…,"sha256":"0123456789abcdef0123456789abcdef"}

The checksum is of the line's bytes before it. So a line that was changed is told from one that a
full disk or a power cut tore, which lacks its end and is skipped, and from one of an earlier
version, which has no checksum. Lines are no chain: processes add them at once, without a lock.
"""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder

FOLDER = "runs"
ANCHORS = "documents"
"""Name of the anchors in the record of a run (`fleet_slip.runs.anchors`)."""

RECORD_COLUMNS = {
    "run_id": "VARCHAR",
    "command": "VARCHAR",
    "arguments": "VARCHAR[]",
    "started_at": "VARCHAR",
    "ended_at": "VARCHAR",
    "outcome": "VARCHAR",
    "exit_code": "INTEGER",
    "error": "VARCHAR",
    "seconds": "DOUBLE",
    "steps": "STRUCT(name VARCHAR, seconds DOUBLE, rows BIGINT, size_bytes BIGINT)[]",
    "host": "VARCHAR",
    "process": "INTEGER",
    "process_began": "VARCHAR",
    "package_version": "VARCHAR",
}
"""What a line of the history may say, with DuckDB's types."""

_DIGITS = 32
_END = b',"sha256":"' + b"0" * _DIGITS + b'"}'
_SEALED = re.compile(rb'(.*),"sha256":"([0-9a-f]{%d})"\}' % _DIGITS)


def write_line(record: Mapping[str, Any]) -> bytes:
    """Return a record as a line with its checksum, without the end of the line."""
    body = json.dumps(record, separators=(",", ":")).encode().removesuffix(b"}")
    return body + b',"sha256":"' + _checksum(body) + b'"}'


def is_intact(line: bytes) -> bool:
    """Whether a line is what was written."""
    return bool(line) and not _is_torn(line) and not _is_changed(line)


def changed_lines(content: bytes) -> list[int]:
    """Return the numbers of the lines, from 1, that are not what was written; torn ones are."""
    lines = enumerate(content.split(b"\n"), 1)
    return [n for n, line in lines if line and not _is_torn(line) and _is_changed(line)]


def find_changed_lines(root: Folder, since: str = "") -> Iterator[tuple[str, str]]:
    """Yield the files of the history that have changed lines, below the root, and which.

    `since` is the first month that is looked at, as YYYY-MM. What is no file is passed over.
    """
    folder = root / FOLDER
    for file in folder.files():
        if not file.path.endswith(".jsonl") or file.path < since:
            continue
        try:
            (content,) = folder.read_many([file.path])
        except StorageError:
            continue
        for number in changed_lines(content or b""):
            yield f"{FOLDER}/{file.path}", f"line {number} is not what a run has written"


def require_unchanged(root: Folder, since: str = "") -> None:
    """Raise `StorageError` if a line of the history was changed."""
    for path, problem in find_changed_lines(root, since):
        raise StorageError(
            f"{root}/{path}: {problem}; it was changed or damaged. Restore the file from a backup, "
            "or delete the line: the others stand for themselves."
        )


def _is_torn(line: bytes) -> bool:
    """Whether a line lacks its end, as a write that did not finish leaves it."""
    return not (_ends(line) or _ends(line[:-1]) or _parsed(line) is not None)


def _ends(line: bytes) -> bool:
    """Whether a line ends as sealed lines do, but for one byte."""
    there = line[-len(_END) :]
    if len(there) < len(_END):
        return False
    pairs = zip(there, _END, strict=True)
    hexadecimal = b"0123456789abcdef"
    return sum(a != b and not (b == 48 and a in hexadecimal) for a, b in pairs) <= 1


def _is_changed(line: bytes) -> bool:
    if found := _SEALED.fullmatch(line):
        return _checksum(found[1]) != found[2]
    record = _parsed(line)
    # An earlier version wrote no checksum, but no other keys either.
    return record is None or not record.keys() <= {*RECORD_COLUMNS, ANCHORS}


def _parsed(line: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def _checksum(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest()[:_DIGITS].encode()
