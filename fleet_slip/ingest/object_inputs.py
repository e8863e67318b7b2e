"""Logs on an object store: found by their URL, and copied as a listing found them."""

import hashlib
import re
from collections.abc import Iterator
from itertools import takewhile
from os import environ
from pathlib import Path

import obstore
from fsspec.utils import glob_translate
from obstore.exceptions import InvalidPathError

from fleet_slip.base import needed
from fleet_slip.errors import InputError, StorageError
from fleet_slip.storage.folder import StoredFile
from fleet_slip.storage.objects import (
    CONNECT_TIMEOUT_S,
    TIMEOUT_S,
    ObjectFolder,
    client,
    fetch_parts,
)
from fleet_slip.storage.storage_errors import (
    NoSuchObjectError,
    meaning_of,
    object_errors,
    storage_errors,
)

ATTEMPTS = 3
"""So often an object is fetched that does not arrive as the store says that it is."""

_COMPARABLE = re.compile(r"[0-9a-f]{32}(-[1-9][0-9]{0,4})?")
"""A tag that may be an MD5, or the MD5 of the MD5s of so many parts."""

_PART_SIZES = (5, 8, 10, 15, 16, 25, 32, 50, 64, 100, 128, 256, 512)
"""Sizes of a part that uploaders choose."""

_URL = re.compile(r"(?P<bucket>(?:s3|gs|az)://[a-z0-9][a-z0-9._-]{1,62})(?:/+(?P<path>.*))?")


def list_any_names(bucket: ObjectFolder, path: str) -> Iterator[StoredFile]:
    """Yield the objects below a folder of a bucket of S3. Raises `StorageError`."""
    with needed("objects", "a listing of an object store"):
        from botocore.config import Config  # noqa: PLC0415 - a fifth of a second
        from botocore.exceptions import BotoCoreError, ClientError  # noqa: PLC0415
        from botocore.session import Session  # noqa: PLC0415
    # It finds credentials and endpoints where we do. Paths hold for stores of all makers.
    limits = {"connect_timeout": CONNECT_TIMEOUT_S, "read_timeout": TIMEOUT_S}
    store = Session().create_client(
        "s3",
        region_name=environ.get("AWS_REGION"),
        config=Config(s3={"addressing_style": "path"}, **limits),
    )
    name = bucket.bucket.removeprefix("s3://")
    try:
        pages = store.get_paginator("list_objects_v2").paginate(
            Bucket=name, Prefix=f"{path}/" if path else ""
        )
        for page in pages:
            for one in page.get("Contents", ()):
                meta = {"path": one["Key"], "size": one["Size"]}
                changed = {"last_modified": one["LastModified"], "e_tag": one["ETag"]}
                yield bucket.found({**meta, **changed})
    except (BotoCoreError, ClientError) as error:
        raise StorageError(f"{bucket}/{path}: {meaning_of(error)}") from None


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

    Raises `InputError` if it is gone, replaced, or not as its tag's checksum; and `StorageError`.
    """
    arrived = set[str]()
    with storage_errors(copy):
        copy.parent.mkdir(parents=True, exist_ok=True)
    for _ in range(ATTEMPTS):
        digest = _copy_once(file, copy)
        # A tag that looks like a checksum may be none: then two transfers that agree must do.
        if not _COMPARABLE.fullmatch(file.identity) or digest in arrived:
            return
        if digest == file.identity or _is_of_parts(copy, file.identity):
            return
        arrived.add(digest)
    raise InputError(
        f"{file}: it arrived {ATTEMPTS} times with other bytes than the store has. Run the same "
        "command again, and have the network examined."
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


def _is_of_parts(copy: Path, tag: str) -> bool:
    """Whether a tag is the MD5 of the MD5s of N parts, of any size that uploaders choose."""
    stated, _, number = tag.partition("-")
    size, parts = copy.stat().st_size, int(number or 0)
    lengths = (one * unit for unit in (2**20, 10**6) for one in _PART_SIZES)
    return any(-(-size // n) == parts and _md5_of_parts(copy, n) == stated for n in lengths)


def _md5_of_parts(copy: Path, length: int) -> str:
    whole = hashlib.md5(usedforsecurity=False)
    with copy.open("rb") as stream:
        while part := stream.read(length):
            whole.update(hashlib.md5(part, usedforsecurity=False).digest())
    return whole.hexdigest()


def _listed(bucket: ObjectFolder, path: str) -> list[StoredFile]:
    where = f"{bucket}/{path}"
    with object_errors(where):
        try:
            pages = list(obstore.list(client(bucket.bucket), path or None))
        except InvalidPathError:
            if not bucket.bucket.startswith("s3://"):
                raise
            return sorted(list_any_names(bucket, path), key=str)
    return sorted((bucket.found(meta) for page in pages for meta in page), key=str)
