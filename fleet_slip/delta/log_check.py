"""Looks at the part of a Delta log that a version of a table is told from, whenever it is opened.

A flipped bit there removes a file or brings one back, or says that a signal is in every row: each
makes wrong sums of sound files. So the newest checkpoint is compared with the checksum kept of it,
and every commit after it with the one that it states. `fleet_slip.delta.commit_check` looks at the
whole log, and at what it adds up to.
"""

import functools

from fleet_slip.delta.checkpoints import newest_checkpoint, require_sealed
from fleet_slip.delta.commits import COMMIT_FILE, LOG, commit_number, problem_of_commit, read_commit
from fleet_slip.delta.sealing import SEAL
from fleet_slip.errors import StorageError
from fleet_slip.files.folder import Folder, StoredFile

REMEMBERED_COMMITS = 2**14


def require_sound_log(table: Folder, version: int) -> None:
    """Raise `StorageError` if what a version of a table is told from was damaged.

    A file is read once by a process, as long as it stays the same. The log of an object store is
    looked at by `verify` alone: another look would be at another answer.
    """
    if not table.is_local:
        return
    files = (table / LOG).files()
    checkpoint = newest_checkpoint(files, version)
    if checkpoint is not None:
        require_sealed(table, checkpoint.name)
    after = commit_number(checkpoint.name) if checkpoint else -1
    commits = [file for file in files if COMMIT_FILE.fullmatch(file.name)]
    sealed = bool(commits) and _is_sealed(commits[0])
    for file in commits:
        if after < commit_number(file.name) <= version and (problem := _problem(file, sealed)):
            raise StorageError(
                f"{file}: {problem}. See what can be repaired with: fleet-slip verify --repair; or "
                "restore the log from a backup."
            )


@functools.lru_cache(maxsize=REMEMBERED_COMMITS)
def _problem(file: StoredFile, must_be_sealed: bool) -> str | None:
    try:
        return problem_of_commit(read_commit(file.folder, file.name), must_be_sealed)
    except ValueError as error:
        return str(error)


@functools.lru_cache(maxsize=REMEMBERED_COMMITS)
def _is_sealed(file: StoredFile) -> bool:
    """Whether a commit states its checksum, after which all later ones do."""
    try:
        return SEAL in read_commit(file.folder, file.name).note
    except ValueError:
        return False
