"""Checks the Delta log of a table: its commits against their checksums, and its state against them.

A flipped bit in a data file's path, size or count is found beside the file. One in the name of a
unit of work, in a note or in a commit that lies behind a checkpoint is found here only.
"""

from collections.abc import Iterator, Sequence

from fleet_slip.delta import Snapshot
from fleet_slip.delta.commits import (
    COMMIT_FILE,
    LOG,
    Commit,
    commit_number,
    problem_of_commit,
    read_commit,
)
from fleet_slip.delta.sealing import SEAL


def find_commit_faults(snapshot: Snapshot) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with the log up to a snapshot: the commit's file below it, and what."""
    if snapshot.version is None:
        return
    commits = []
    must_be_sealed = False
    log, there = snapshot.table.folder / LOG, _names(snapshot)
    # Earlier ones were cleaned away.
    first = min(map(commit_number, there), default=snapshot.version)
    for name in (f"{number:020}.json" for number in range(first, snapshot.version + 1)):
        if name not in there:
            yield name, "is missing"
            continue
        try:
            commit = read_commit(log, name)
        except ValueError as error:
            yield name, str(error)
            continue
        must_be_sealed |= SEAL in commit.note
        if problem := problem_of_commit(commit, must_be_sealed):
            yield name, problem
        commits.append(commit)
    if len(commits) == snapshot.version + 1:
        yield from _state_problems(snapshot, commits)


def _names(snapshot: Snapshot) -> set[str]:
    """Return the files of the commits that the log still has, up to the snapshot's."""
    last = f"{snapshot.version:020}.json"
    names = (snapshot.table.folder / LOG).names()
    return {name for name in names if COMMIT_FILE.fullmatch(name) and name <= last}


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
    wrong = [name for name, number in units.items() if snapshot.landed(name) != number]
    if wrong:
        yield "_last_checkpoint", f"does not know what has landed: {', '.join(wrong[:3])}"
