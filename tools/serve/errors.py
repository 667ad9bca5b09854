"""Refusals of a request: a gRPC status and a sentence for the client."""

from __future__ import annotations

import grpc

from augment.errors import ClimateGSError


class RequestRefused(ClimateGSError):
    """A request cannot be served as it is.

    Attributes:
        code: the gRPC status.
    """

    def __init__(self, code: grpc.StatusCode, text: str) -> None:
        super().__init__(text)
        self.code = code


class RequestEnded(Exception):
    """The client has cancelled the request, or its deadline has passed.

    Attributes:
        code: the gRPC status.
    """

    def __init__(self, code: grpc.StatusCode, text: str) -> None:
        super().__init__(text)
        self.code = code


def invalid(text: str) -> RequestRefused:
    """Return the refusal of a request with a wrong field."""
    return RequestRefused(grpc.StatusCode.INVALID_ARGUMENT, text)


def unimplemented(text: str) -> RequestRefused:
    """Return the refusal of a request for what this server cannot do."""
    return RequestRefused(grpc.StatusCode.UNIMPLEMENTED, text)


def quote_text(text: str) -> str:
    """Return a client's text for messages and logs: printable, at most 80 characters."""
    return repr(text if len(text) <= 80 else text[:77] + "...")
