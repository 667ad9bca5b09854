"""The check of every request to the server: who may open a page and connect to it.

The check runs at the handshake, before viser handles anything.

A browser lets every site that its user visits send requests to this machine, also under a name
that the site's owner points here. So a request is answered only where all of these hold:

- it has the token of the printed address, in the address or in the cookie that the page sets;
- its `Host` is this machine, if pages are only for browsers on this machine;
- its `Origin`, if it has one, is the address of the page itself.

A page runs only its own scripts and none that are made from text. It connects only to the server
that sent it. Nothing is ever shared through other servers.
"""

from __future__ import annotations

import contextlib
import hmac
import http
import ipaddress
import re
import secrets
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qsl

from augment.errors import ClimateGSError

TOKEN_BYTES = 24  # The length of the secret in the printed address, bytes.
TOKEN_FIELD = "token"  # The field of the address's query that holds the secret.
MAX_PAGES = 32  # The most pages that are open at one time.
_HOST = re.compile(r"(?P<name>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(:\d{1,5})?")
_REFUSAL = (
    "This is climategs view. Its pages open at the address that the command has printed, with the "
    "token in it.\n"
)


class Access:
    """The rule by which one server admits requests.

    Args:
        is_local: If True, pages are for browsers on this machine only.
    """

    def __init__(self, *, is_local: bool) -> None:
        self.is_local = is_local
        self.token = secrets.token_urlsafe(TOKEN_BYTES)

    def refusal(self, path: str, headers: Any, port: int) -> str | None:
        """Return why a request is refused; None if it is not.

        Args:
            path: Path and query of the request.
            headers: websockets' headers of the request.
            port: The port of the server; the cookie's name has it, too.
        """
        hosts = headers.get_all("Host")
        match = _HOST.fullmatch(hosts[0]) if len(hosts) == 1 else None
        if match is None:
            return "the request names no host"
        host = match[0]
        if self.is_local and not is_loopback(match["name"].strip("[]").lower()):
            return f"{host} is no name of this machine for itself"
        origins = headers.get_all("Origin")
        if origins and origins not in ([f"http://{host}"], [f"https://{host}"]):
            return "the request comes from a page of another site"
        query = parse_qsl(path.partition("?")[2], keep_blank_values=True)
        # viser's page connects to other servers, or plays files of others, if its address says so.
        if any(name != TOKEN_FIELD for name, _ in query):
            return "the address has more than a token"
        if not any(
            map(self._is_token, [*(text for _, text in query), *self._cookies(headers, port)])
        ):
            return "the address has not the token that was printed"
        return None

    def page_headers(self, host: str, port: int) -> dict[str, str]:
        """Return the headers of a page: what it may do, and the cookie for its connection.

        Args:
            host: The request's `Host`, which `refusal` has checked.
            port: As for `refusal`.
        """
        # MDX, in which texts of others could hold code, would need 'unsafe-eval', and so would
        # viser's splats, which pages do not use.
        policy = {
            "default-src": "'self' data: blob:",
            "script-src": "'unsafe-inline' 'wasm-unsafe-eval' blob:",
            "style-src": "'unsafe-inline'",
            "connect-src": f"'self' ws://{host} wss://{host} data: blob:",
            "object-src": "'none'",
            "base-uri": "'none'",
            "form-action": "'none'",
            "frame-ancestors": "'none'",
        }
        return {
            "Content-Security-Policy": "; ".join(map(" ".join, policy.items())),
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "Set-Cookie": f"{_cookie(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict",
        }

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode("utf-8", "replace"), self.token.encode())

    def _cookies(self, headers: Any, port: int) -> list[str]:
        """Return the values of the request's cookies that have our cookie's name."""
        parts = (part.strip() for line in headers.get_all("Cookie") for part in line.split(";"))
        pairs = (part.partition("=") for part in parts)
        return [value for name, _, value in pairs if name == _cookie(port)]


def is_loopback(name: str) -> bool:
    """Return True if a host's name or address is this machine's for itself."""
    if name == "localhost":
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def start_server(
    viser: Any, access: Access, host: str, port: int, *, script: str, **options: Any
) -> Any:
    """Return a viser server that answers only requests that `access` admits, and shares nothing.

    Args:
        viser: The module viser.
        access: The rule by which requests are admitted.
        host: The address at which pages are served.
        port: The port; the next free one is taken if it is in use.
        script: JavaScript that the page runs first.
        options: Options of `websockets.serve`, which replace viser's.

    Raises:
        ClimateGSError: requests to this version of viser cannot be checked.
    """

    class PrivateServer(viser.ViserServer):
        """viser's server without its tunnel to the internet, which any page could ask for."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Share nothing."""

        def disconnect_share_url(self) -> None:
            """Do nothing: nothing is shared."""

    with _guarded_handshakes(access, script, options) as guards:
        server = PrivateServer(host=host, port=port, verbose=False)
    if not guards:
        server.stop()
        raise ClimateGSError(
            f"viser {viser.__version__} starts its server in a way in which climategs cannot check "
            f"who connects: pip install 'viser==1.1.0'"
        )
    return server


@contextlib.contextmanager
def _guarded_handshakes(
    access: Access, script: str, options: dict[str, Any]
) -> Iterator[list[Any]]:
    """Make websockets servers that start within the block ask `access` first.

    viser has no option for it. The list that the block gets has one item for each such server.
    """
    import websockets.asyncio.server as module
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    plain_serve = module.serve
    guards = list[Any]()

    def guarded_serve(
        handler: Any, *args: Any, process_request: Callable[..., Any], **viser_options: Any
    ) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            port = connection.local_address[1]
            if access.refusal(request.path, request.headers, port) is not None:
                return _text(http.HTTPStatus.FORBIDDEN, _REFUSAL)
            if len(connection.server.connections) >= MAX_PAGES:
                text = f"climategs view: {MAX_PAGES} pages are open, which is all there may be.\n"
                return _text(http.HTTPStatus.SERVICE_UNAVAILABLE, text)
            if "Accept-Encoding" in request.headers:
                del request.headers["Accept-Encoding"]  # a script is put into the page's text
            response = process_request(connection, request)
            if response is not None:
                script_and_end = f"<script>{script}</script></body>".encode()
                response.body = response.body.replace(b"</body>", script_and_end)
                headers = access.page_headers(request.headers["Host"], port)
                for name, value in {**headers, "Content-Length": str(len(response.body))}.items():
                    if name in response.headers:
                        del response.headers[name]
                    response.headers[name] = value
            return response

        guards.append(access)
        merged = {**viser_options, **options}
        return plain_serve(handler, *args, process_request=answer, **merged)

    def _text(status: http.HTTPStatus, text: str) -> Any:
        body = text.encode()
        headers = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
        return Response(status.value, status.phrase, Headers(headers), body)

    module.serve = guarded_serve
    try:
        yield guards
    finally:
        module.serve = plain_serve


def _cookie(port: int) -> str:
    """Return the cookie's name. It has the port: a browser sends cookies to all ports of a host."""
    return f"climategs-view-{port}"
