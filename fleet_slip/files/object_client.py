"""The client for a bucket of an object store: its credentials, time limits and retries.

With AWS_ACCESS_KEY_ID set no file is read. Else botocore (for obstore) and delta-rs follow Amazon's
chain: ~/.aws/credentials and ~/.aws/config (AWS_PROFILE, AWS_SHARED_CREDENTIALS_FILE,
AWS_CONFIG_FILE) with roles, processes and single sign-on, then roles of machines, renewed in time.
"""

import functools
import os
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from os import environ
from typing import TYPE_CHECKING, Any

from obstore.store import from_url

from fleet_slip.errors import StorageError
from fleet_slip.extras import needed
from fleet_slip.files.storage_errors import object_errors

if TYPE_CHECKING:
    from botocore.credentials import Credentials
    from obstore.store import ObjectStore


FRESH = timedelta(minutes=1)
"""For so long a copy of credentials is used before botocore is asked, which knows their end."""

CHAIN_VARIABLE = "AWS_FORCE_CREDENTIAL_LOAD"
"""Option of the Delta library: follow Amazon's chain even where AWS_ENDPOINT_URL is set."""

HTTP_VARIABLE = "AWS_ALLOW_HTTP"
"""Environment variable, which the Delta library reads too: true lets an endpoint be http."""

TIMEOUT_S = 60
"""Longest that one request may take: a log file has up to 40 MB."""

CONNECT_TIMEOUT_S = 5
RETRIES = 5
RETRY_S = 60
"""No attempt begins later than so long after the first."""


@dataclass(frozen=True)
class AwsProfile:
    """What a profile says of S3, where credentials are not in the environment."""

    credentials: "Credentials"
    region: str | None
    endpoint: str | None

    @property
    def store_options(self) -> dict[str, Any]:
        """Options of obstore."""
        return {"credential_provider": self._fresh, **self._location}

    @property
    def delta_options(self) -> dict[str, str]:
        """Options of the Delta library, which looks for the credentials itself."""
        return {CHAIN_VARIABLE: "true"} | self._location

    @property
    def _location(self) -> dict[str, str]:
        known = {"region": self.region, "endpoint": self.endpoint}
        return {name: value for name, value in known.items() if value}

    def _fresh(self) -> dict[str, Any]:
        found = self.credentials.get_frozen_credentials()
        return {
            "access_key_id": found.access_key,
            "secret_access_key": found.secret_key,
            "token": found.token,
            "expires_at": datetime.now(UTC) + FRESH if found.token else None,
        }


@functools.cache
def aws_profile() -> AwsProfile | None:
    """Return the profile in use, unless the environment has credentials. Raises `StorageError`."""
    if environ.get("AWS_ACCESS_KEY_ID"):
        return None
    with needed("objects", "a file of credentials"):
        # A fifth of a second to import.
        from botocore.exceptions import BotoCoreError, ProfileNotFound  # noqa: PLC0415
        from botocore.session import Session  # noqa: PLC0415
    session = Session()
    try:
        credentials = session.get_credentials()
        if credentials is not None:
            credentials.get_frozen_credentials()
        scoped = session.get_scoped_config()
        region = session.get_config_variable("region")
    except ProfileNotFound:
        raise StorageError(
            f"there is no profile {session.profile!r} in ~/.aws/config or ~/.aws/credentials. "
            "Check AWS_PROFILE, AWS_CONFIG_FILE and AWS_SHARED_CREDENTIALS_FILE."
        ) from None
    except (BotoCoreError, OSError, RuntimeError, ValueError) as error:
        # Its text may quote what a process printed.
        raise StorageError(
            f"the credentials of the AWS profile {session.profile or 'default'!r} cannot be had "
            f"({type(error).__name__}). Check them with: aws sts get-caller-identity"
        ) from None
    if credentials is None:
        raise StorageError(
            "there are no credentials for S3. Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
            "AWS_PROFILE, or run: aws configure"
        )
    endpoint = environ.get("AWS_ENDPOINT_URL_S3") or environ.get("AWS_ENDPOINT_URL")
    endpoint = endpoint or scoped.get("endpoint_url")
    return AwsProfile(credentials, region, endpoint)


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
