"""An S3 server in this process, and failures to order: answers 500, cut connections, delays.

    with s3_server() as server:
        store = open_store(server.uri("out"))
        server.fail(next=2, status=503, method="PUT")    # the next two uploads are refused
        store.write("a.bin", b"...")                     # and still arrive
        assert server.requests[-1].startswith("PUT")

The server is moto's; its objects live as long as the block. Credentials are placed in the
environment for that time, as anyone who uses S3 has them there, so that child processes find
them too. `bucket` exists, and is another one each time.
"""

from __future__ import annotations

import contextlib
import http.client
import io
import itertools
import os
import socket
import threading
import time
import urllib.parse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal
from unittest import mock

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "testing",
    "AWS_SECRET_ACCESS_KEY": "testing-secret",
    "AWS_EC2_METADATA_DISABLED": "true",  # else finding no region takes seconds
}
_numbers = itertools.count()

Cut = Literal["upload", "answer"]


@dataclass
class Fault:
    """What happens to the next requests that fit; see S3Server.fail."""

    left: int
    method: str | None
    path: str
    status: int | None
    cut: Cut | None
    ignore: str
    delay_s: float

    def fits(self, method: str, target: str) -> bool:
        return self.left > 0 and self.method in (None, method) and self.path in target


@dataclass
class S3Server:
    """A running server; `requests` holds every request so far, as `PUT /bucket/key?query`."""

    endpoint: str  # host:port
    bucket: str
    requests: list[str] = field(default_factory=list)
    _faults: list[Fault] = field(default_factory=list)
    _lock: Any = field(default_factory=threading.Lock)

    def uri(self, path: str = "", *, credentials: str = "") -> str:
        """What open_store takes for a folder of the bucket; `credentials` are `user:password@`."""
        endpoint = urllib.parse.quote(f"http://{self.endpoint}", safe="")
        options = f"endpoint_override={endpoint}&scheme=http&region=us-east-1"
        return f"s3://{credentials}{self.bucket}/{path}?{options}"

    def fail(
        self,
        next: int = 1,
        *,
        status: int | None = None,
        cut: Cut | None = None,
        ignore: str = "",
        delay_s: float = 0.0,
        method: str | None = None,
        path: str = "",
    ) -> None:
        """Spoil the next requests whose method is `method` and whose target contains `path`.

        status: answer that (500, 503, 403 ...) and do nothing else. cut: "upload" reads half of
        the body and closes the connection; "answer" does what was asked for, then closes it
        without a word. ignore: this header, as WSGI calls it. delay_s: first wait that long;
        alone, the request then succeeds. Orders add up, the oldest first.
        """
        with self._lock:
            self._faults.append(Fault(next, method, path, status, cut, ignore, delay_s))

    def forgive(self) -> None:
        """Forget all orders of failures."""
        with self._lock:
            self._faults.clear()

    def keys(self) -> dict[str, int]:
        """Every object in the bucket with its size; markers of folders end in a slash."""
        from moto.s3.models import s3_backends

        (backend,) = s3_backends["123456789012"].values()
        return {name: key.size for name, key in backend.buckets[self.bucket].keys.items()}

    def take_fault(self, method: str, target: str) -> Fault | None:
        """The oldest order that fits, used up by one; notes the request."""
        with self._lock:
            self.requests.append(f"{method} {target}")
            found = next((fault for fault in self._faults if fault.fits(method, target)), None)
            if found is not None:
                found.left -= 1
            return found


@contextlib.contextmanager
def s3_server() -> Iterator[S3Server]:
    """A server on a free port of 127.0.0.1 with one empty bucket, for the length of the block."""
    from moto.moto_server.werkzeug_app import (
        DomainDispatcherApplication,
        MotoRequestHandler,
        create_backend_app,
    )
    from werkzeug.serving import make_server

    class Quiet(MotoRequestHandler):
        def log(self, type: str, message: str, *args: object) -> None:
            pass

    application = DomainDispatcherApplication(create_backend_app)
    server = S3Server("", f"bucket-{os.getpid()}-{next(_numbers)}")

    def answer(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        return _answer(server, application, environ, start_response)

    listener = make_server("127.0.0.1", 0, answer, threaded=True, request_handler=Quiet)
    host, port = listener.server_address[:2]
    server.endpoint = f"{host}:{port}"
    thread = threading.Thread(target=listener.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        _request(server, "PUT", f"/{server.bucket}")
        with mock.patch.dict(os.environ, CREDENTIALS):
            yield server
    finally:
        server.forgive()
        _request(server, "POST", "/moto-api/reset")
        listener.shutdown()
        thread.join()
        listener.server_close()


def _request(server: S3Server, method: str, target: str) -> None:
    connection = http.client.HTTPConnection(server.endpoint, timeout=60)
    try:
        connection.request(method, target)
        status = connection.getresponse().status
        assert status == 200, (method, target, status)
    finally:
        connection.close()


def _answer(
    server: S3Server, application: Any, environ: dict[str, Any], start_response: Any
) -> Iterable[bytes]:
    query = environ.get("QUERY_STRING", "")
    target = environ["PATH_INFO"] + (f"?{query}" if query else "")
    fault = server.take_fault(environ["REQUEST_METHOD"], target)
    if fault is None:
        return application(environ, start_response)
    time.sleep(fault.delay_s)
    body: io.BufferedIOBase = environ["wsgi.input"]
    is_chunked = environ.get("HTTP_TRANSFER_ENCODING") == "chunked"
    length = -1 if is_chunked else int(environ.get("CONTENT_LENGTH") or 0)
    if fault.cut == "upload":
        body.read(max(length // 2, 1))
        return _cut(environ)
    data = body.read(length)
    environ.pop("HTTP_TRANSFER_ENCODING", None)
    if fault.status is not None:
        start_response(f"{fault.status} Ordered", [("Content-Length", "0")])
        return [b""]
    environ.pop(fault.ignore, None)
    environ |= {"wsgi.input": io.BytesIO(data), "CONTENT_LENGTH": str(len(data))}
    if fault.cut == "answer":
        list(application(environ, lambda *_: None))
        return _cut(environ)
    return application(environ, start_response)


def _cut(environ: dict[str, Any]) -> Iterable[bytes]:
    environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
    raise ConnectionAbortedError
