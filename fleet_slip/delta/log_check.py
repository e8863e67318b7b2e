"""Checks a table's Delta log against the checksums that it states and that are kept of it.

A flipped bit loses a file, or brings one back. So on opening, the newest checkpoint and the commits
after it are compared; `verify` looks at all commits, and at what they add up to.
"""

import functools
from collections.abc import Iterator, Sequence

from fleet_slip.delta.checkpoints import (
    COMMIT_FILE,
    LOG,
    newest_checkpoint,
    require_kept_checksum,
    version_of,
)
from fleet_slip.delta.commits import CHECKSUM_KEY, Commit, problem_of_commit, read_commit
from fleet_slip.delta.snapshot import Snapshot
from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder, StoredFile

REMEMBERED_COMMITS = 2**14


def require_sound_log(table: Folder, version: int) -> None:
    """Raise `StorageError` if what a version of a table is told from was damaged.

    Each file is read once by a process; of an object store, `verify` alone looks.
    """
    if not table.is_local:
        return
    files = (table / LOG).files()
    checkpoint = newest_checkpoint(files, version)
    if checkpoint is not None:
        require_kept_checksum(table, checkpoint.name)
    after = version_of(checkpoint.name) if checkpoint else -1
    commits = [file for file in files if COMMIT_FILE.fullmatch(file.name)]
    checked = bool(commits) and _states_checksum(commits[0])
    for file in commits:
        if after < version_of(file.name) <= version and (problem := _problem(file, checked)):
            raise StorageError(
                f"{file}: {problem}. See what can be repaired with: fleet-slip verify --repair; or "
                "restore the log from a backup."
            )


@functools.lru_cache(maxsize=REMEMBERED_COMMITS)
def _problem(file: StoredFile, must_state_checksum: bool) -> str | None:
    try:
        return problem_of_commit(read_commit(file.folder, file.name), must_state_checksum)
    except ValueError as error:
        return str(error)


@functools.lru_cache(maxsize=REMEMBERED_COMMITS)
def _states_checksum(file: StoredFile) -> bool:
    """Whether a commit states its checksum, after which all later ones do."""
    try:
        return CHECKSUM_KEY in read_commit(file.folder, file.name).note
    except ValueError:
        return False


def find_commit_faults(snapshot: Snapshot) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with the log up to a snapshot: the commit's file below it, and what."""
    if snapshot.version is None:
        return
    commits = []
    must_state_checksum = False
    log, last = snapshot.table.folder / LOG, f"{snapshot.version:020}.json"
    there = {name for name in log.names() if COMMIT_FILE.fullmatch(name) and name <= last}
    # Earlier ones were cleaned away.
    first = min(map(version_of, there), default=snapshot.version)
    for name in (f"{number:020}.json" for number in range(first, snapshot.version + 1)):
        if name not in there:
            yield name, "is missing"
            continue
        try:
            commit = read_commit(log, name)
        except ValueError as error:
            yield name, str(error)
            continue
        must_state_checksum |= CHECKSUM_KEY in commit.note
        if problem := problem_of_commit(commit, must_state_checksum):
            yield name, problem
        commits.append(commit)
    if len(commits) == snapshot.version + 1:
        yield from _state_problems(snapshot, commits)


def _state_problems(snapshot: Snapshot, commits: Sequence[Commit]) -> Iterator[tuple[str, str]]:
    """Compare what the commits add up to with what the Delta library says, from a checkpoint."""
    files: set[str] = set()
    units: dict[str, int] = {}
    for action in (action for commit in commits for action in commit.actions):
        match action:
            case {"add": {"path": path}}:
                files.add(path)
            case {"remove": {"path": path}}:
                files.discard(path)
            case {"txn": {"appId": name, "version": number}}:
                units[name] = number
    if files != {file.path for file in snapshot.files}:
        yield "_last_checkpoint", "the active files are not those that the commits add up to"
    known = snapshot.units
    wrong = [name for name, number in units.items() if known.get(name) != number]
    if wrong:
        yield "_last_checkpoint", f"does not know what has landed: {', '.join(wrong[:3])}"
