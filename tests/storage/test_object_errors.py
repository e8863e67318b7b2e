"""What object stores answer, as their libraries tell it, and what a person is told of it."""

import pytest
from obstore.exceptions import GenericError, NotFoundError

from fleet_slip.errors import StorageError
from fleet_slip.storage.storage_errors import known_meaning, meaning_of, object_errors

SECRET = "AKIDSECRETOFSOMEBODY"  # noqa: S105 - made up

ANSWERS = {
    "there are no credentials": [
        "Generic S3 error: Error performing PUT http://169.254.169.254/latest/api/token in 3s",
        "Generic GCS error: error sending request for url (http://metadata.google.internal/x)",
        "Generic MicrosoftAzure error: Account must be specified",
        "no providers in chain provided credentials",
    ],
    "there is no such bucket": [
        "<Code>NoSuchBucket</Code><Message>The specified bucket does not exist</Message>",
        "404 Not Found: ContainerNotFound",
        "Object at location x not found: the specified bucket does not exist",
    ],
    "the store refuses the credentials": [
        f"Client error with status 403 Forbidden: InvalidAccessKeyId {SECRET}",
        "403 Forbidden: SignatureDoesNotMatch",
        "400 Bad Request: ExpiredToken",
        "403 Forbidden: RequestTimeTooSkewed",
        "server returned 401 Unauthorized",
    ],
    "the credentials do not permit this": [
        f"403 Forbidden: <Code>AccessDenied</Code><AWSAccessKeyId>{SECRET}</AWSAccessKeyId>",
        "AuthorizationPermissionMismatch",
        "Client error with status 403 Forbidden: No Body",
    ],
    "the endpoint is http": ["builder error: URL scheme is not allowed", "BadScheme"],
    "does not know conditional writes": ["501 Not Implemented: If-None-Match", "NotImplemented"],
    "answers with errors": [
        "Server error with status 500 Internal Server Error",
        "Server error with status 503 Service Unavailable: SlowDown",
        "429 Too Many Requests",
        "<Code>InternalError</Code>",
    ],
    "does not answer in time": ["operation timed out", "HTTP error: request or response TimedOut"],
    "cannot be reached": [
        "error sending request for url (http://127.0.0.1:9/bucket)",
        "dns error: failed to lookup address information",
        "tcp connect error: Connection refused (os error 111)",
    ],
    "there is no such object": ["NoSuchKey", "404 Not Found", "Object at location x not found: y"],
}


@pytest.mark.parametrize(
    ("answer", "told"), [(text, told) for told, texts in ANSWERS.items() for text in texts]
)
def test_an_answer_is_told_by_its_most_telling_part(answer: str, told: str) -> None:
    """Several patterns may fit: a bucket that is not there is also 404, a wrong key 403."""
    meaning = known_meaning(OSError(answer))
    assert meaning is not None
    assert told in meaning
    assert meaning_of(OSError(answer)) == meaning
    assert "\n" not in meaning
    assert meaning.endswith((".", "AWS_ALLOW_HTTP=true"))
    assert SECRET not in meaning


@pytest.mark.parametrize("answer", ["", "a surprise", "4500 bytes", "port 5000", "1429 rows"])
def test_what_is_not_known_is_not_guessed(answer: str) -> None:
    assert known_meaning(OSError(answer)) is None
    assert meaning_of(OSError(answer)).startswith("the store cannot be used (OSError)")


@pytest.mark.parametrize("kind", [GenericError, NotFoundError, OSError, ValueError])
def test_failures_of_a_store_become_ours_with_the_place_and_without_the_answer(
    kind: type[Exception],
) -> None:
    with (
        pytest.raises(StorageError, match=r"^s3://bucket/data: the store refuses the") as told,
        object_errors("s3://bucket/data"),
    ):
        raise kind(f"<Error><Code>InvalidAccessKeyId</Code>{SECRET}</Error>")
    assert SECRET not in str(told.value)
    assert told.value.__cause__ is None
    assert told.value.__suppress_context__
