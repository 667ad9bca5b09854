"""What pyarrow's failures of remote file systems mean: whether they pass, and what to do.

pyarrow says it in words only: `AWS Error ACCESS_DENIED during PutObject operation: ...`.
"""

from __future__ import annotations

import re

_DENIED = re.compile(
    r"ACCESS_DENIED|INVALID_ACCESS_KEY|SIGNATURE_DOES_NOT_MATCH|INVALID_CLIENT_TOKEN|EXPIRED_TOKEN"
    r"|ExpiredToken|UNRECOGNIZED_CLIENT|INVALID_SIGNATURE|MISSING_AUTHENTICATION_TOKEN"
    r"|NOT_INITIALIZED|REQUEST_TIME_TOO_SKEWED|PERMISSION_DENIED|UNAUTHENTICATED|credentials"
    r"|AuthorizationHeaderMalformed|HTTP status 40[13]"
)
_NOWHERE = re.compile(
    r"NO_SUCH_BUCKET|no bucket|RESOURCE_NOT_FOUND|NOT_FOUND|PermanentRedirect|HTTP status 30\d"
)
_REFUSED = re.compile(r"HTTP status 4(?!08|29)\d\d|EntityTooLarge|INVALID_PARAMETER|MALFORMED")

_CREDENTIALS = {
    "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (or AWS_PROFILE), the region",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS",
    "gcs": "GOOGLE_APPLICATION_CREDENTIALS",
}
_ENDPOINT = {"s3": ", the region, and the endpoint (endpoint_override or AWS_ENDPOINT_URL)"}


def is_permanent(failure: Exception) -> bool:
    """Whether trying again is of no use."""
    if isinstance(failure, FileNotFoundError | PermissionError | IsADirectoryError):
        return True
    if not isinstance(failure, OSError):  # arguments that pyarrow refuses, what it cannot do ...
        return True
    text = str(failure)
    return any(pattern.search(text) for pattern in (_DENIED, _NOWHERE, _REFUSED))


def advice(failure: Exception, scheme: str) -> str:
    """What to do about it."""
    text = str(failure)
    if isinstance(failure, PermissionError) or _DENIED.search(text):
        named = _CREDENTIALS.get(scheme, "the credentials")
        return f"check {named}, and that they may read, write, list and delete there"
    if isinstance(failure, FileNotFoundError) or _NOWHERE.search(text):
        return f"check the bucket's name, that it exists{_ENDPOINT.get(scheme, '')}"
    if is_permanent(failure):
        return "the store refuses this for good: check its address and options"
    return (
        f"check the network{_ENDPOINT.get(scheme, '')}, then run the same command again: "
        f"every file there is whole"
    )
