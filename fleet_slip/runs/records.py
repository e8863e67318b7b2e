"""Lines of the history of runs, each with its own checksum, and what is wrong with a line.

    {"run_id":…,"documents":…,"sha256":"0123456789abcdef0123456789abcdef"}

The checksum is of the bytes before it: a changed line differs from a torn one, which lacks its end,
and an old one, which has none. Lines are no chain: processes add them without a lock.

Every run keeps number and checksum of the newest document of each folder, to tell that the last
ones are gone; whoever deletes these and rewrites all records leaves no trace: docs/security.md.
"""

import contextlib
import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from fleet_slip.errors import StorageError
from fleet_slip.files.documents import DocumentFolder
from fleet_slip.files.folder import Folder

PROC = Path("/proc")
START = 19
"""Place of the start among the fields behind the name, proc(5): ticks since the machine booted."""

FOLDER = "runs"
NEWEST_DOCUMENTS = "documents"
"""Name of the newest documents in the record of a run."""

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

_DOCUMENT_FOLDER = re.compile(r"forgotten|models/(?!\.\./)[^/]*/(?:versions|history)")

_DIGITS = 32
_END = b',"sha256":"' + b"0" * _DIGITS + b'"}'
_WITH_CHECKSUM = re.compile(rb'(.*),"sha256":"([0-9a-f]{%d})"\}' % _DIGITS)


def process_began(number: int) -> str | None:
    """Return a process's boot and start, whatever the clock, since numbers are reused; or None."""
    try:
        boot = (PROC / "sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        status = (PROC / str(number) / "stat").read_bytes()
    except OSError:
        return None
    return f"{boot}/{status.rpartition(b')')[2].split()[START].decode()}"


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
    """Yield the files, from a month YYYY-MM on, that have changed lines, and which."""
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
    """Whether a line ends as a line with a checksum does, but for one byte."""
    there = line[-len(_END) :]
    if len(there) < len(_END):
        return False
    pairs = zip(there, _END, strict=True)
    hexadecimal = b"0123456789abcdef"
    return sum(a != b and not (b == 48 and a in hexadecimal) for a, b in pairs) <= 1


def _is_changed(line: bytes) -> bool:
    if found := _WITH_CHECKSUM.fullmatch(line):
        return _checksum(found[1]) != found[2]
    record = _parsed(line)
    # An earlier version wrote no checksum, but no other keys either.
    return record is None or not record.keys() <= {*RECORD_COLUMNS, NEWEST_DOCUMENTS}


def _parsed(line: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def _checksum(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest()[:_DIGITS].encode()


def newest_documents(root: Folder) -> dict[str, tuple[int, str]]:
    """Return the newest documents as they are now; nothing of a folder that cannot be read."""
    found = {}
    for path in _document_folders(root):
        documents = DocumentFolder(root / path)
        with contextlib.suppress(StorageError):
            if numbers := documents.numbers():
                found[path] = (numbers[-1], documents.read(numbers[-1]).sha256)
    return found


def find_missing_documents(root: Folder, since: str = "") -> Iterator[tuple[str, str]]:
    """Yield the folders that lost documents that a run since YYYY-MM had seen, and what."""
    for path, (number, sha256) in sorted(_newest_seen(root, since).items()):
        documents = DocumentFolder(root / path)
        newest = max(documents.numbers(), default=0)
        if newest < number:
            yield path, f"had {number} documents when a run ended, and has {newest} now"
            continue
        with contextlib.suppress(StorageError):  # told as a document
            if documents.read(number).sha256 != sha256:
                yield path, f"{number}.json is not the document that a run had seen"


def _newest_seen(root: Folder, since: str) -> dict[str, tuple[int, str]]:
    folder = root / FOLDER
    paths = [f.path for f in folder.files() if f.path.endswith(".jsonl") and f.path >= since]
    kept: dict[str, tuple[int, str]] = {}
    for content in folder.read_many(paths):
        for line in (content or b"").splitlines():
            for path, number, sha256 in _newest_in(line):
                if number >= kept.get(path, (0, ""))[0]:
                    kept[path] = (number, sha256)
    return kept


def _newest_in(line: bytes) -> Iterator[tuple[str, int, str]]:
    """Yield the newest documents that a line tells, none if it is torn, changed or without them."""
    if not is_intact(line):
        return
    try:
        record: Any = json.loads(line)
        found = record.get(NEWEST_DOCUMENTS) or {}
        for path, (number, sha256) in found.items():
            if _DOCUMENT_FOLDER.fullmatch(str(path)):
                yield str(path), int(number), str(sha256)
    except (ValueError, TypeError, AttributeError, RecursionError):
        return


def _document_folders(root: Folder) -> list[str]:
    models = [f"models/{name}" for name in (root / "models").names()]
    return [
        "forgotten",
        *(f"{model}/{kind}" for model in models for kind in ("versions", "history")),
    ]
