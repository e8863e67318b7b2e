"""Files that commands read from an object store: found by URL, and copied to be read."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import obstore
from fsspec.utils import glob_translate

from fleet_slip.errors import InputError
from fleet_slip.files.folder import StoredFile
from fleet_slip.files.object_client import client
from fleet_slip.files.object_errors import object_errors
from fleet_slip.files.object_folder import ObjectFolder
from fleet_slip.files.storage_errors import storage_errors

CHUNK_BYTES = 2**23

_URL = re.compile(r"(?P<bucket>(?:s3|gs|az)://[a-z0-9][a-z0-9._-]{1,62})(?:/+(?P<path>.*))?")


def parse_url(url: str) -> tuple[ObjectFolder, str]:
    """Return the bucket of a URL, and the path in it. Raises `InputError`.

    A URL that is refused is not shown: what is wrong with it may be that it has a password.
    """
    found = _URL.fullmatch(url)
    if found is None:
        raise InputError(
            "a file on an object store is written as s3://BUCKET/PATH, gs://BUCKET/PATH or "
            "az://CONTAINER/PATH. Credentials are not part of it: they come from the environment."
        )
    return ObjectFolder(found["bucket"], ""), (found["path"] or "").rstrip("/")


def find_object(url: str) -> StoredFile | None:
    """Return the object of the very name, None if there is none. Raises `StorageError`."""
    bucket, path = parse_url(url)
    if not path:
        return None
    with object_errors(url):
        try:
            return bucket.found(obstore.head(client(bucket.bucket), path))
        except FileNotFoundError:
            return None


def find_below(url: str) -> list[StoredFile]:
    """Return the objects below a folder, at any depth, or those that match a pattern, sorted.

    `*` and `?` stand for characters of one name, `**` for folders. Raises `StorageError`.
    """
    bucket, path = parse_url(url)
    whole = path.split("/")
    plain = [part for part in whole if not is_pattern(part)]
    if len(plain) == len(whole):
        return _listed(bucket, path)
    first = next(at for at, part in enumerate(whole) if is_pattern(part))
    matches = re.compile(glob_translate(path)).match
    return [file for file in _listed(bucket, "/".join(whole[:first])) if matches(file.path)]


def is_pattern(text: str) -> bool:
    """Whether a text has characters that stand for others."""
    return any(c in text for c in "*?[")


def copy_object(file: StoredFile, copy: Path) -> None:
    """Copy an object as a listing found it to a file, whose folder is made.

    Raises `InputError` if another has taken its place since, and `StorageError`.
    """
    folder = file.folder
    assert isinstance(folder, ObjectFolder)  # noqa: S101 - where else?
    with object_errors(str(file)):
        answer = obstore.get(client(folder.bucket), file.path)
        now = folder.found(answer.meta)
    copied = 0
    with storage_errors(copy):
        copy.parent.mkdir(parents=True, exist_ok=True)
        with copy.open("xb") as stream:
            for chunk in _chunks(answer, str(file)):
                copied += stream.write(chunk)
    if (now.identity, copied) != (file.identity, file.size_bytes):
        raise InputError(f"{file}: it changed while it was read. Wait until it is complete.")


def _chunks(answer: Any, where: str) -> Iterator[memoryview]:
    with object_errors(where):
        for chunk in answer.stream(min_chunk_size=CHUNK_BYTES):
            yield memoryview(chunk)


def _listed(bucket: ObjectFolder, path: str) -> list[StoredFile]:
    with object_errors(f"{bucket}/{path}"):
        pages = list(obstore.list(client(bucket.bucket), path or None))
    return sorted((bucket.found(meta) for page in pages for meta in page), key=str)
