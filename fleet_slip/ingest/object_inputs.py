"""Logs on an object store: found by their URL, and copied as a listing found them."""

import hashlib
import re
from itertools import takewhile
from pathlib import Path

import obstore
from fsspec.utils import glob_translate

from fleet_slip.errors import InputError
from fleet_slip.storage.folder import StoredFile
from fleet_slip.storage.objects import ObjectFolder, client, fetch_parts
from fleet_slip.storage.storage_errors import NoSuchObjectError, object_errors, storage_errors

ATTEMPTS = 3
"""So often an object is fetched that does not arrive as the store says that it is."""

_MD5 = re.compile(r"[0-9a-f]{32}")
_URL = re.compile(r"(?P<bucket>(?:s3|gs|az)://[a-z0-9][a-z0-9._-]{1,62})(?:/+(?P<path>.*))?")


def parse_url(url: str) -> tuple[ObjectFolder, str]:
    """Return bucket and path of a URL. Raises `InputError`, which may not show a password."""
    found = _URL.fullmatch(url)
    if found is None:
        raise InputError(
            "a file on an object store is written as s3://BUCKET/PATH, gs://BUCKET/PATH or "
            "az://CONTAINER/PATH. Credentials are not part of it: they come from the environment."
        )
    path = (found["path"] or "").rstrip("/")
    if not {".", ".."}.isdisjoint(path.split("/")):
        raise InputError(
            f"{found['bucket']}: a path in a bucket has no folder '.' or '..'. Write it "
            "as the store lists it."
        )
    return ObjectFolder(found["bucket"], ""), path


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
    """Return objects below a folder, or that match a pattern with `*`, `?`, `**`, sorted."""
    bucket, path = parse_url(url)
    folders = list(takewhile(lambda part: not set("*?[").intersection(part), path.split("/")))
    folder = "/".join(folders)
    if folder == path:
        return _listed(bucket, path)
    matches = re.compile(glob_translate(path)).match
    return [file for file in _listed(bucket, folder) if matches(file.path)]


def copy_object(file: StoredFile, copy: Path) -> None:
    """Copy an object as a listing found it to a file, whose folder is made.

    A tag that looks like an MD5 is compared; that of some stores is none: then two transfers that
    agree must do. Raises `InputError` if the object is gone, replaced, or arrives otherwise; and
    `StorageError`.
    """
    arrived = set[str]()
    with storage_errors(copy):
        copy.parent.mkdir(parents=True, exist_ok=True)
    for _ in range(ATTEMPTS):
        digest = _copy_once(file, copy)
        if digest in arrived or digest == file.identity or not _MD5.fullmatch(file.identity):
            return
        arrived.add(digest)
    raise InputError(
        f"{file}: its bytes differed from the store's in {ATTEMPTS} transfers. Run the same "
        "command again, and check the network."
    )


def _copy_once(file: StoredFile, copy: Path) -> str:
    folder = file.folder
    assert isinstance(folder, ObjectFolder)  # noqa: S101 - where else?
    md5, copied = hashlib.md5(usedforsecurity=False), 0
    try:
        with storage_errors(copy), copy.open("wb") as stream:
            for meta, part in fetch_parts(client(folder.bucket), file.path, str(file)):
                if folder.found(meta).identity != file.identity:
                    break
                copied += stream.write(part)
                md5.update(part)
    except NoSuchObjectError as error:
        raise InputError(str(error)) from None
    if copied != file.size_bytes:
        raise InputError(f"{file}: it changed while it was read. Wait until it is complete.")
    return md5.hexdigest()


def _listed(bucket: ObjectFolder, path: str) -> list[StoredFile]:
    with object_errors(f"{bucket}/{path}"):
        pages = list(obstore.list(client(bucket.bucket), path or None))
    return sorted((bucket.found(meta) for page in pages for meta in page), key=str)
