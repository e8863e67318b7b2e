"""Location of a data root: a folder of a file system, or the URL of an object store."""

import os
import re
import time
from pathlib import Path
from urllib.parse import unquote, urlsplit

from fleet_slip.base import require_extra
from fleet_slip.errors import StorageError
from fleet_slip.storage.folder import Folder

DEFAULT_ROOT = Path("data")
UNFIT_CHARACTERS = "\\*?["
"""The backslash becomes a slash in Delta; the others are patterns to DuckDB."""

_ESCAPE = re.compile("%[0-9A-Fa-f]{2}")
"""What stands for another character in a URL, as which the Delta library takes a path."""

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_OBJECT_URL = re.compile(
    r"(?P<bucket>(?:s3|gs|az)://[a-z0-9][a-z0-9._-]{1,62})(?P<path>(?:/[A-Za-z0-9_=+-][\w.=+-]*)*)/?",
    re.ASCII,
)


def data_root(root: Folder | Path | str | None = None) -> Folder:
    """Return the data root: the argument, else ./data.

    With `://` it is a URL: `s3://BUCKET/PATH`, `gs://`, `az://CONTAINER/PATH`, `file:///PATH`.
    Raises `StorageError` for another, for what Delta or DuckDB misread, inside a table, and where
    the clock is before 1970, which Delta cannot write.
    """
    if time.time() < 0:
        raise StorageError("the clock of this machine is before 1970. Set it, and repeat.")
    if root is not None and not isinstance(root, Path | str):
        return root
    where = root or DEFAULT_ROOT
    if isinstance(where, str) and _SCHEME.match(where):
        return _at_url(where)
    return _local(Path(where))


def _local(path: Path) -> Folder:
    unfit = [c for c in str(path) if not c.isprintable() or c in UNFIT_CHARACTERS]
    if unfit:
        raise StorageError(
            f"{path}: a data root cannot have {unfit[0]!r} in its path. Choose another."
        )
    if match := _ESCAPE.search(str(path.absolute())):
        raise StorageError(
            f"{path}: a data root cannot have {match[0]!r} in its full path: Delta reads it as one "
            "character. Choose another."
        )
    for folder in (place := Path(os.path.realpath(path)), *place.parents):
        # Whatever lies in a table and is not part of it, vacuum removes.
        if os.access(folder / "_delta_log", os.F_OK):
            raise StorageError(
                f"{path}: it is inside the table {folder}. Choose the folder that the table is in, "
                "or another."
            )
    from fleet_slip.storage.local import LocalFolder

    return LocalFolder(path)


def _at_url(url: str) -> Folder:
    # A URL that is refused is not shown: what is wrong with it may be that it has a password.
    if url.startswith("file://"):
        parts = urlsplit(url)
        if parts.netloc not in ("", "localhost") or parts.query or parts.fragment:
            raise StorageError("a data root at a file URL is written as file:///PATH.")
        return _local(Path(unquote(parts.path)))
    match = _OBJECT_URL.fullmatch(url)
    if match is None:
        raise StorageError(
            "a data root on an object store is written as s3://BUCKET/PATH, gs://BUCKET/PATH "
            "or az://CONTAINER/PATH, with letters, digits and any of _ . = + - in the path. "
            "Credentials are not part of it: they come from the environment."
        )
    with require_extra("objects", "a data root on an object store"):
        from fleet_slip.storage.objects import ObjectFolder
    return ObjectFolder(match["bucket"], match["path"].strip("/"))
