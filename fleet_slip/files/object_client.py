"""The client for a bucket of an object store: its credentials, time limits and retries."""

import functools
import os
from datetime import timedelta
from typing import TYPE_CHECKING

from obstore.store import from_url

from fleet_slip.files.object_credentials import AwsProfile, aws_profile
from fleet_slip.files.object_errors import object_errors

if TYPE_CHECKING:
    from obstore.store import ObjectStore

HTTP_VARIABLE = "AWS_ALLOW_HTTP"
"""Environment variable, which the Delta library reads too: true lets an endpoint be http."""

TIMEOUT_S = 60
"""Longest that one request may take: a log file has up to 40 MB."""

CONNECT_TIMEOUT_S = 5
RETRIES = 5
RETRY_S = 60
"""No attempt begins later than so long after the first."""


def profile_of(bucket: str) -> AwsProfile | None:
    """Return where credentials are, if it is a bucket of S3 and they are not in the environment."""
    return aws_profile() if bucket.startswith("s3://") else None


@functools.cache
def client(bucket: str) -> "ObjectStore":
    """Return the client for a bucket, which a process makes when it first needs it."""
    profile = profile_of(bucket)
    with object_errors(bucket):
        return from_url(
            bucket,
            client_options={
                "allow_http": os.environ.get(HTTP_VARIABLE, "").lower() in ("1", "true"),
                "timeout": timedelta(seconds=TIMEOUT_S),
                "connect_timeout": timedelta(seconds=CONNECT_TIMEOUT_S),
            },
            retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRY_S)},
            **(profile.store_options if profile else {}),
        )


def delta_options(bucket: str) -> dict[str, str]:
    """Return the same for the Delta library; credentials it finds where we do."""
    profile = profile_of(bucket)
    return {
        "timeout": f"{TIMEOUT_S}s",
        "connect_timeout": f"{CONNECT_TIMEOUT_S}s",
        "max_retries": f"{RETRIES}",
        "retry_timeout": f"{RETRY_S}s",
        "conditional_put": "etag",
        **(profile.delta_options if profile else {}),
    }
