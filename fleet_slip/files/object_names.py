"""Lists objects of S3 whatever their names are.

The library that talks to object stores gives a listing up at a name that it takes for no path, such
as `a//b` or `a/../b`, and all other names with it. Amazon's own library lists any.
"""

from collections.abc import Iterator
from os import environ

from fleet_slip.errors import StorageError
from fleet_slip.extras import needed
from fleet_slip.files.folder import StoredFile
from fleet_slip.files.object_client import CONNECT_TIMEOUT_S, TIMEOUT_S, profile_of
from fleet_slip.files.object_errors import meaning_of
from fleet_slip.files.object_folder import ObjectFolder


def list_any_names(bucket: ObjectFolder, path: str) -> Iterator[StoredFile]:
    """Yield the objects below a folder of a bucket of S3. Raises `StorageError`."""
    with needed("objects", "a listing of an object store"):
        from botocore.config import Config  # noqa: PLC0415 - a fifth of a second
        from botocore.exceptions import BotoCoreError, ClientError  # noqa: PLC0415
        from botocore.session import Session  # noqa: PLC0415
    profile = profile_of(bucket.bucket)
    endpoint = environ.get("AWS_ENDPOINT_URL_S3") or environ.get("AWS_ENDPOINT_URL")
    style = "path" if endpoint else "auto"
    limits = {"connect_timeout": CONNECT_TIMEOUT_S, "read_timeout": TIMEOUT_S}
    store = Session().create_client(
        "s3",
        region_name=(profile and profile.region) or environ.get("AWS_REGION"),
        endpoint_url=(profile and profile.endpoint) or endpoint,
        config=Config(s3={"addressing_style": style}, **limits),
    )
    name = bucket.bucket.removeprefix("s3://")
    try:
        pages = store.get_paginator("list_objects_v2").paginate(
            Bucket=name, Prefix=f"{path}/" if path else ""
        )
        for page in pages:
            for one in page.get("Contents", ()):
                yield bucket.found(
                    {
                        "path": one["Key"],
                        "size": one["Size"],
                        "last_modified": one["LastModified"],
                        "e_tag": one["ETag"],
                    }
                )
    except (BotoCoreError, ClientError) as error:
        raise StorageError(f"{bucket}/{path}: {meaning_of(error)}") from None
