"""What every store and every claim promises, on a disk and on a server that fails."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import http.client
import io
import itertools
import os
import pickle
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal
from unittest import mock

import numpy as np
import pytest

from augment.errors import OutputError
from augment.jobs.blocks import read_status
from augment.jobs.generate import run_generate
from augment.output.atomic import TEMPORARY_SUFFIX
from augment.output.claims import CLAIMS_FOLDER, ClaimTimes, try_claim, try_lock
from augment.output.store import (
    LocalStore,
    RemoteStore,
    RetrySettings,
    StoredFileMissing,
    open_store,
)
from tests.augment.generate_jobs import image_name, make_job, make_recipes, outputs
from tools.view.outputs import OutputViewer, find_output

# ---- An S3 server in this process, and failures to order ----------------------------------------

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "testing",
    "AWS_SECRET_ACCESS_KEY": "testing-secret",
    "AWS_EC2_METADATA_DISABLED": "true",  # else finding no region takes seconds
}


@dataclass
class Fault:
    """What happens to the next requests that fit; see S3Server.fail."""

    left: int
    method: str | None
    path: str
    status: int | None
    cut: Literal["upload", "answer"] | None
    ignore: str
    delay_s: float


@dataclass
class S3Server:
    """moto's server with one bucket; `requests` are all requests so far, as `PUT /bucket/key`."""

    endpoint: str = ""  # host:port
    bucket: str = f"bucket-{os.getpid()}"
    requests: list[str] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    lock: Any = field(default_factory=threading.Lock)

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
        cut: Literal["upload", "answer"] | None = None,
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
        with self.lock:
            self.faults.append(Fault(next, method, path, status, cut, ignore, delay_s))

    def forgive(self) -> None:
        """Forget all orders of failures."""
        with self.lock:
            self.faults.clear()

    def take_fault(self, method: str, target: str) -> Fault | None:
        """The oldest order that fits, used up by one; notes the request."""
        with self.lock:
            self.requests.append(f"{method} {target}")
            for fault in self.faults:
                if fault.left > 0 and fault.method in (None, method) and fault.path in target:
                    fault.left -= 1
                    return fault
        return None

    def request(self, method: str, target: str, body: bytes | None = None) -> None:
        connection = http.client.HTTPConnection(self.endpoint, timeout=60)
        with contextlib.closing(connection):
            connection.request(method, target, body)
            assert connection.getresponse().status == 200, (method, target)


@pytest.fixture(scope="module")
def shared_server() -> Iterator[S3Server]:
    """On a free port of 127.0.0.1; its credentials are in the environment, for children too."""
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
    server = S3Server()

    def answer(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        return answer_or_fail(server, application, environ, start_response)

    listener = make_server("127.0.0.1", 0, answer, threaded=True, request_handler=Quiet)
    server.endpoint = f"127.0.0.1:{listener.server_address[1]}"
    thread = threading.Thread(target=listener.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    server.request("PUT", f"/{server.bucket}")
    with mock.patch.dict(os.environ, CREDENTIALS):
        yield server
    listener.shutdown()
    thread.join()
    listener.server_close()


def answer_or_fail(
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
        return hang_up(environ)
    data = body.read(length)
    environ.pop("HTTP_TRANSFER_ENCODING", None)
    if fault.status is not None:
        start_response(f"{fault.status} Ordered", [("Content-Length", "0")])
        return [b""]
    environ.pop(fault.ignore, None)
    environ |= {"wsgi.input": io.BytesIO(data), "CONTENT_LENGTH": str(len(data))}
    if fault.cut == "answer":
        list(application(environ, lambda *_: None))
        return hang_up(environ)
    return application(environ, start_response)


def hang_up(environ: dict[str, Any]) -> Iterable[bytes]:
    environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
    raise ConnectionAbortedError


QUICK = RetrySettings(3, 0.001, timeout_s=5.0)
_numbers = itertools.count()


@pytest.fixture
def server(shared_server: S3Server) -> S3Server:
    shared_server.forgive()
    return shared_server


@pytest.fixture
def remote(server: S3Server) -> RemoteStore:
    return RemoteStore(server.uri(f"test-{next(_numbers)}"), QUICK)


@pytest.fixture(params=["local", "s3"])
def store(request, tmp_path):
    if request.param == "local":
        return open_store(tmp_path / "out")
    return open_store(request.getfixturevalue("server").uri(f"test-{next(_numbers)}/o%20t"))


# ---- What every store promises ------------------------------------------------------------------


def test_what_was_written_is_read(store, tmp_path):
    assert store.list("") == {}
    assert not store.exists("a/b.txt")
    store.write("a/b.txt", b"first and longer")
    store.write("a/b.txt", b"second")
    store.write("a.gz", b"not compressed")
    store.write("a/empty", b"")
    assert store.read("a/b.txt") == b"second"
    assert store.read("a.gz") == b"not compressed"
    assert store.read("a/empty") == b""
    assert store.exists("a/b.txt") and not store.exists("a") and not store.exists("b.txt")
    assert {path: file.size for path, file in store.list("").items()} == {
        "a.gz": 14,
        "a/b.txt": 6,
        "a/empty": 0,
    }
    assert list(store.list("a")) == ["a/b.txt", "a/empty"]
    assert store.list("a/b") == store.list("nothing") == {}
    for path in ("nothing", "a/c", "c/b", "a/empty/c"):
        with pytest.raises(StoredFileMissing, match=path):
            store.read(path)
    for other in (pickle.loads(pickle.dumps(store)), open_store(store.uri)):
        assert other.read("a.gz") == b"not compressed"
        assert other.uri == store.uri and other.local_dir == store.local_dir
    store.delete(["a/b.txt", "a/empty", "never/there"])
    assert list(store.list("")) == ["a.gz"]


def test_files_are_put(store, tmp_path):
    source = tmp_path / "source.bin"
    source.write_bytes(b"12345")
    for _ in range(2):
        store.put_file("a/b", source)
        assert store.read("a/b") == b"12345"
    for missing in (tmp_path / "nothing", tmp_path):
        with pytest.raises(OutputError, match=r"cannot read |Is a directory"):
            store.put_file("a/b", missing)
    store.write("a/b", b"6")
    assert source.read_bytes() == b"12345"
    assert list(store.list("")) == ["a/b"]


def test_hostile_paths_are_refused(store, tmp_path):
    for path in (
        "",
        "/",
        "/etc/passwd",
        "..",
        "a/../../x",
        "a\\b",
        "a\0b",
        "a\nb",
        "//x",
        "\udcff",
    ):
        calls = [store.read, store.exists, lambda path: store.write(path, b"")]
        calls += [lambda path: store.delete(["fine", path])]
        calls += [lambda path: store.put_file(path, tmp_path)]
        calls += [store.list] if path else []
        for call in calls:
            with pytest.raises(OutputError, match="no path of a file there"):
                call(path)


# ---- On a disk ----------------------------------------------------------------------------------


def test_local_places(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expected = tmp_path / "a b"
    for uri in (expected, "a b", Path("a b"), f"file://{tmp_path}/a%20b"):
        store = open_store(uri)
        assert (store.local_dir, store.uri) == (expected, str(expected))
    assert open_store(f"file://localhost{tmp_path}").local_dir == tmp_path
    for uri in ("file://elsewhere/a", "file://"):
        with pytest.raises(OutputError, match="absolute"):
            open_store(uri)
    assert not expected.exists()


def test_local_files_are_linked_or_else_copied(tmp_path, monkeypatch):
    store = LocalStore(tmp_path / "out")
    source = tmp_path / "source"
    source.write_bytes(b"1")
    link = tmp_path / "link"
    link.symlink_to(source)
    store.put_file("a/linked", link)
    assert os.path.samefile(source, tmp_path / "out/a/linked")
    assert not (tmp_path / "out/a/linked").is_symlink()

    def refuse(*_, **__):
        raise OSError(errno.EXDEV, "another disk")

    monkeypatch.setattr(os, "link", refuse)
    store.put_file("a/copied", source)
    store.put_file("a/linked", source)
    assert store.read("a/copied") == store.read("a/linked") == b"1"
    assert not os.path.samefile(source, tmp_path / "out/a/linked")
    assert sorted(os.listdir(tmp_path / "out/a")) == ["copied", "linked"]


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    store = LocalStore(tmp_path)
    store.write("a/b", b"old")
    (tmp_path / "source").write_bytes(b"new")

    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    for call in (
        lambda: store.write("a/b", b"n"),
        lambda: store.put_file("a/b", tmp_path / "source"),
    ):
        with pytest.raises(OutputError, match="disk is full"):
            call()
    assert store.read("a/b") == b"old"
    assert os.listdir(tmp_path / "a") == ["b"]


def test_links_do_not_lead_out_and_temporaries_are_no_files(tmp_path):
    (tmp_path / "secret").write_text("x")
    store = LocalStore(tmp_path / "out")
    store.write("a", b"")
    (tmp_path / "out/up").symlink_to(tmp_path)
    (tmp_path / "out/dangling").symlink_to("nothing")
    (tmp_path / "out" / f".x{TEMPORARY_SUFFIX}").write_bytes(b"half")
    for call in (
        lambda: store.read("up/secret"),
        lambda: store.write("up/new", b""),
        lambda: store.delete(["up/secret"]),
    ):
        with pytest.raises(OutputError, match="through a link"):
            call()
    assert list(store.list("")) == ["a"]
    assert (tmp_path / "secret").exists()


def test_emptied_folders_go_and_the_root_stays(tmp_path):
    store = LocalStore(tmp_path / "out")
    store.write("a/b/c/d", b"")
    store.write("a/e", b"")
    store.delete(["a/b/c/d"])
    assert os.listdir(tmp_path / "out/a") == ["e"]
    with pytest.raises(OutputError, match=r"cannot read .*a: Is a directory"):
        store.read("a")
    with pytest.raises(OutputError, match=r"cannot delete .*a"):
        store.delete(["a"])
    store.delete(["a/e", "a/e/f"])
    assert os.listdir(tmp_path / "out") == []


def test_writing_where_others_delete_the_folder(tmp_path):
    """Each deletes the other's folder all the time; no write fails."""
    store = LocalStore(tmp_path)

    def work(name):
        for _ in range(30):
            store.write(f"a/b/{name}", b"x")
            store.delete([f"a/b/{name}"])

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, "01"))
    assert os.listdir(tmp_path) == []


# ---- On a server --------------------------------------------------------------------------------


def test_wrong_uris():
    for uri, message in (
        ("s4a://bucket/x", "no stores of the kind 's4a'"),
        ("http://host/x", "no stores of the kind 'http'"),
        ("s3:///x", "no bucket"),
        ("s3://bucket/a/../b", "without"),
        ("s3://bucket/a/%2e%2e/b", "without"),
        ("s3://bucket/a#b", "without"),
        ("s3://bucket//b", "without"),
        ("s3://bucket/x?regoin=eu", "no option 'regoin'.*region"),
        # None of them says a password.
        ("s3://me:word@bucket/x?access_key=word", "^[^w]*no option 'access_key'"),
        ("s3://me:word@bucket/x?region", "^[^w]*no URI"),
        ("s3://me:word@[bucket/x", "^[^w]*no URI"),
        ("gs://me:word@bucket/x", "^[^w]*no option 'user@'"),
        ("az://box:word@account/x", "^[^w]*no option 'user@'"),
        ("abfs://box@account.x/y?account_key=word", "^[^w]*no option 'account_key'"),
    ):
        with pytest.raises(OutputError, match=f"(?i){message}"):
            open_store(uri)
    for uri in ("abfs://box@account.dfs.core.windows.net/y", "gs://anonymous@bucket/x"):
        assert open_store(uri).uri == uri


def test_credentials_stay_inside(server):
    secret = "pass/word%2Bplus"
    store = RemoteStore(server.uri("out", credentials="someone:pass%2Fword%252Bplus@"), QUICK)
    store.write("a", b"1")
    assert pickle.loads(pickle.dumps(store)).read("a") == b"1"
    server.fail(4, status=500)
    with pytest.raises(OutputError) as caught:
        store.write("someone", b"1")
    for text in (store.uri, repr(store), str(caught.value)):
        assert "pass" not in text and secret not in text
    assert "someone" not in store.uri and caught.value.__cause__ is None
    assert open_store(store.uri).read("a") == b"1"


def test_what_keeps_a_server_from_answering_is_said(server, remote, monkeypatch):
    wrong = RemoteStore(server.uri("out").replace(server.bucket, "none"), QUICK)
    for call in (lambda: wrong.read("a"), lambda: wrong.list(""), lambda: wrong.write("a", b"")):
        with pytest.raises(OutputError, match="NoSuchBucket; check the bucket's name") as caught:
            call()
        assert not isinstance(caught.value, StoredFileMissing)
    nobody = RemoteStore("s3://bucket/out?endpoint_override=127.0.0.1:1&scheme=http", QUICK)
    with pytest.raises(OutputError, match=r"list s3://bucket/out: .*3 retries.*AWS_ENDPOINT_URL"):
        nobody.list("")
    for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3"):
        monkeypatch.setenv(name, "http://127.0.0.1:1")
    remote.write("a", b"1")  # its own options go before the environment
    uri = "s3://box/out?endpoint_override=nowhere.invalid&force_virtual_addressing=true"
    with pytest.raises(OutputError, match=r"https://box\.nowhere\.invalid"):
        RemoteStore(uri, QUICK).list("")
    with pytest.raises(OutputError, match=r"cannot read /none\.pem"):
        open_store(f"{remote.uri}&tls_ca_file_path=/none.pem").list("")
    for status in (400, 401, 403):  # refused for good: not tried again
        before = len(server.requests)
        server.fail(10, status=status)
        with pytest.raises(OutputError, match=r"cannot write [^;]*; .*check") as caught:
            remote.write("a", b"2")
        server.forgive()
        assert len(server.requests) == before + 1 and "retries" not in str(caught.value)
        assert ("AWS_ACCESS_KEY_ID" in str(caught.value)) == (status != 400)


@pytest.mark.long
def test_writes_arrive_after_failures_or_leave_what_was_there(server, remote):
    for fault in ({"status": 500}, {"status": 503}, {"cut": "upload"}, {"cut": "answer"}):
        remote.write("a", b"the old one")
        server.fail(QUICK.retries, method="PUT", **fault)
        remote.write("a", b"the new one, longer")
        assert remote.read("a") == b"the new one, longer"
        server.fail(QUICK.retries + 1, method="PUT", **fault)
        with pytest.raises(OutputError, match=r"cannot write s3://.*/a: .*after 3 retries"):
            remote.write("a", b"the third one")
        has_arrived = fault == {"cut": "answer"}
        assert remote.read("a") == (b"the third one" if has_arrived else b"the new one, longer")
        server.forgive()
    big = b"0123456789" * 1_100_000  # three parts of an upload
    server.fail(1, method="PUT", path="partNumber=1", status=403)
    with pytest.raises(OutputError, match="privileges"):
        remote.write("b", big)
    assert not remote.exists("b")
    server.fail(1, method="PUT", path="partNumber=1", cut="upload")
    remote.write("b", big)
    assert remote.read("b") == big
    impatient = RemoteStore(remote.uri, RetrySettings(6, 0.001, timeout_s=1.0))
    server.fail(1, method="PUT", delay_s=1.6, status=500)
    impatient.write("a", b"2")
    assert remote.read("a") == b"2"


def test_what_others_left_is_not_listed_or_named(server, remote):
    path, _, _ = remote.uri.removeprefix("s3:/").partition("?")
    for marker in ("", "good/"):  # of folders
        server.request("PUT", f"{path}/{marker}", b"")
    remote.write("good/b", b"")
    assert list(remote.list("")) == list(remote.list("good")) == ["good/b"]
    for name in ("a//b", "a%01b"):
        server.request("PUT", f"{path}/{name}", b"")
    with pytest.raises(OutputError, match="delete what others have put there"):
        remote.list("")


@pytest.mark.long
def test_forked_children_and_threads_share_a_store(remote):
    remote.write("parent", b"1")
    child = os.fork()
    if child == 0:
        remote.write("child", remote.read("parent"))
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    names = [f"t/{number:02}" for number in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda name: remote.write(name, name.encode()), names))
    assert list(remote.list("")) == ["child", "parent", *names]


@pytest.mark.long
def test_a_remote_output_has_the_files_of_a_local_one(server, tmp_path, monkeypatch) -> None:
    """Requests fail now and then; the job is stopped twice, and what was finished stays so."""
    lazy = SimpleNamespace(collect=lambda: None)
    monkeypatch.setattr("augment.jobs.block_worker.gc", lazy)
    monkeypatch.setattr("augment.output.claims.CLAIM_TIMES", ClaimTimes(0.2))
    scenes = ["fake:a?frames=3"]
    recipes = make_recipes(["fog"], block_images=2)
    run_generate(make_job(tmp_path / "local", scenes, recipes), progress=False)
    local_files = outputs(tmp_path / "local")
    rendered: list[str] = []
    stop_at = [2, 5, -1]

    def renderer(scene, camera, recipe, *, backend):
        if len(rendered) == stop_at[0]:
            raise KeyboardInterrupt
        rendered.append(image_name(scene, camera, recipe))
        return make_job("x").setup.renderer(scene, camera, recipe, backend=backend)

    uri = server.uri("job")
    job = make_job(uri, scenes, recipes, renderer=renderer, scratch=tmp_path / "scratch")
    while stop_at:
        server.fail(1, status=503, method="PUT")
        server.fail(1, cut="answer", method="PUT", path="images")
        if stop_at[0] >= 0:
            with pytest.raises(KeyboardInterrupt, match="start the same job again"):
                run_generate(job, progress=False)
        else:
            assert run_generate(job, progress=False).failed == 0
        stop_at.pop(0)
    assert len(rendered) == len(set(rendered)) == 6
    store = open_store(uri)
    remote_paths = {path for path in store.list("") if not path.startswith(".climategs")}
    assert remote_paths == local_files.keys()
    assert {p: hashlib.sha256(store.read(p)).hexdigest() for p in remote_paths} == local_files
    assert not store.list(CLAIMS_FOLDER)
    assert not any((tmp_path / "scratch" / "blocks").iterdir())
    (status,) = read_status(store)
    assert (status.total.published, status.claims) == (6, 0)
    remote_viewer, local = (find_output(str(at)) for at in (uri, tmp_path / "local"))
    assert (
        remote_viewer is not None and local is not None and find_output(server.uri("other")) is None
    )
    viewers = OutputViewer(remote_viewer), OutputViewer(local)
    remote_image, image = (viewer.picture(viewer.rows[0], "image") for viewer in viewers)
    assert np.array_equal(remote_image, image)


# ---- Claims: one holder at a time, whoever contends, however the last one ended -----------------

OFTEN = ClaimTimes(renewal_s=0.05, lifetime_s=60.0)
SHORT = ClaimTimes(renewal_s=60.0, lifetime_s=1.0)

# Holds "a" in the stores that it is given, and says so; stays, or ends without releasing anything.
HOLDER = """
import sys, time
from augment.output.claims import try_claim
from augment.output.store import open_store
seconds, *uris = sys.argv[1:]
claims = [try_claim(open_store(uri), "a") for uri in uris]
assert None not in claims
print("holding", flush=True)
time.sleep(float(seconds))
"""
# Claims "a" again and again; two never hold it at once.
CONTENDER = """
import os, sys, time
from augment.output.claims import try_claim
from augment.output.store import open_store
uri, mark, left = sys.argv[1], sys.argv[2], int(sys.argv[3])
deadline_s = time.monotonic() + 60
print("contending", flush=True)
while left and time.monotonic() < deadline_s:
    claim = try_claim(open_store(uri), "a")
    if claim is not None:
        with claim:
            os.close(os.open(mark, os.O_CREAT | os.O_EXCL))
            claim.check()
            time.sleep(0.002)
            os.unlink(mark)
        left -= 1
    time.sleep(0.002)
sys.exit(left)
"""


@contextlib.contextmanager
def other_process(code: str, *arguments: str):
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", code, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) as process:
        assert process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


def wait_for(condition):
    deadline_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def test_one_holder_at_a_time(store):
    with try_claim(store, "a") as claim:
        claim.check()
        assert try_claim(store, "a") is None
        with try_claim(store, "b") as other:
            other.check()
        child = os.fork()
        if child == 0:
            claim.release()  # which is not the child's to release
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        claim.check()
        assert try_claim(store, "a") is None
    with pytest.raises(OutputError, match=r"lost: .*released"):
        claim.check()
    assert store.list("") == {}  # nothing is left behind
    claim.release()
    with try_claim(store, "a") as again:
        claim.release()  # of the first, a second time
        again.check()
    for name in ("", "..", "a/b", ".hidden", "a b", "x" * 101, "manifest.parquet"):
        with pytest.raises(ValueError, match="claim's name"):
            try_claim(store, name)


def test_deleted_claims_are_lost(store):
    with try_claim(store, "a") as claim:
        store.delete(store.list(CLAIMS_FOLDER))
        with try_claim(store, "a") as other:
            with pytest.raises(OutputError, match=r"lost: (its .* was deleted|another process)"):
                claim.check()
            claim.release()
            other.check()


def test_a_lock_file_that_changes_hands_while_it_is_opened(tmp_path, monkeypatch):
    """Its holder deletes it, and another one makes and locks the next file of that name."""
    path = tmp_path / "a.lock"
    flock = fcntl.flock
    other_locks = []

    def flock_too_late(descriptor, operation):
        monkeypatch.setattr(fcntl, "flock", flock)
        path.unlink()
        other_locks.append(try_lock(path))
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", flock_too_late)
    assert try_lock(path) is None
    other_locks[0].check()
    other_locks[0].release()
    with try_lock(path) as claim:
        claim.check()


@pytest.mark.long
def test_processes_contend(store, tmp_path):
    arguments = [store.uri, str(tmp_path / "mark"), "10" if store.local_dir else "2"]
    with contextlib.ExitStack() as stack:
        contenders = [stack.enter_context(other_process(CONTENDER, *arguments)) for _ in range(3)]
        assert [process.wait(90) for process in contenders] == [0] * 3
    assert store.list("") == {}


@pytest.mark.long
def test_a_dead_process_is_followed(remote, tmp_path):
    """At once on this machine, after its lifetime elsewhere; where it could, it has released."""
    with other_process(HOLDER, "0", remote.uri) as process:
        assert process.wait(60) == 0
    assert remote.list("") == {}
    local = open_store(tmp_path)
    with other_process(HOLDER, "60", local.uri, remote.uri) as holder:
        assert try_claim(local, "a") is None
        holder.kill()
        holder.wait()
        with try_claim(local, "a") as claim:
            claim.check()
    assert try_claim(remote, "a") is None
    won = []
    wait_for(lambda: won.append(try_claim(remote, "a", SHORT)) or any(won))
    assert try_claim(remote, "a") is None
    won[-1].release()


@pytest.mark.long
def test_of_two_who_find_a_dead_claim_one_takes_it_over(server, remote):
    remote.write(f"{CLAIMS_FOLDER}/a", b"of a dead process")
    time.sleep(3.1)  # its lifetime, and what the store's clock may err by
    server.fail(2, method="GET", path="claims/a", delay_s=0.3)  # both see it before either acts
    with ThreadPoolExecutor(2) as pool:
        claims = list(pool.map(lambda _: try_claim(remote, "a", SHORT), range(2)))
    (claim,) = filter(None, claims)
    claim.release()


@pytest.mark.long
def test_claims_are_renewed_until_they_are_lost(server, remote):
    with try_claim(remote, "a", OFTEN) as claim:
        num_requests = len(server.requests)
        wait_for(lambda: str(server.requests[num_requests:]).count("claims/a") > 2)
        claim.check()
        remote.delete(remote.list(CLAIMS_FOLDER))
        time.sleep(0.3)
        assert remote.list(CLAIMS_FOLDER) == {}
        with pytest.raises(OutputError, match="object was deleted"):
            claim.check()


@pytest.mark.long
def test_a_claim_that_was_not_renewed_in_time_is_lost_and_stays_with_who_took_it(server, remote):
    with try_claim(remote, "a", ClaimTimes(0.2, 1.0)) as claim:
        server.fail(1000, method="PUT", path="claims/a", status=503)
        time.sleep(3.1)
        server.forgive()
        with pytest.raises(OutputError, match=r"not renewed for .* counts as given up after 1 s"):
            claim.check()
        with try_claim(remote, "a", SHORT) as other:
            claim.release()
            assert try_claim(remote, "a") is None
            other.check()


@pytest.mark.long
def test_lost_requests_lose_no_claim(server, remote):
    """Whether a put whose answer was lost has arrived is seen from what is there."""
    faults = [("PUT", "upload"), ("PUT", "answer"), ("GET", "answer"), ("DELETE", "answer")]
    for method, cut in faults:
        server.fail(1, method=method, path="claims/a", cut=cut)
        with try_claim(remote, "a") as claim:
            claim.check()
            assert try_claim(remote, "a") is None
            server.fail(1, method=method, path="claims/a", cut=cut)
        assert remote.list("") == {}
        server.forgive()


@pytest.mark.long
def test_requests_that_arrive_late_hit_no_other_claim(server, remote):
    impatient = RemoteStore(remote.uri, RetrySettings(0, 0.001, timeout_s=0.5))
    with try_claim(impatient, "a", ClaimTimes(0.1, 60.0)) as claim:
        server.fail(2, method="PUT", path="claims/a", delay_s=0.8)
        wait_for(lambda: not any(fault.left for fault in server.faults))
        time.sleep(1.5)
        claim.check()  # the late renewal is the holder's own
    assert remote.list("") == {}
    claims = [try_claim(RemoteStore(remote.uri, RetrySettings(2, 0.001, timeout_s=0.5)), "a")]
    server.fail(1, method="DELETE", path="claims/a", delay_s=0.8)
    claims[0].release()
    wait_for(lambda: claims.append(try_claim(remote, "a")) or claims[-1])
    time.sleep(1.0)
    with claims[-1]:
        claims[-1].check()


@pytest.mark.long
def test_stores_that_cannot_hold_claims_are_refused(server):
    for message, fault in (
        (r"ignores If-None-Match or If-Match", {"ignore": "HTTP_IF_NONE_MATCH"}),
        (r"ignores If-None-Match or If-Match", {"ignore": "HTTP_IF_MATCH"}),
        (r"needs? puts with If-None-Match", {"status": 501}),
        (r"cannot read .*claims/a.*run the same command again", {"status": 503}),
    ):
        store = RemoteStore(server.uri(f"test-{next(_numbers)}"), QUICK)
        place = {"path": "claims/a"} if fault == {"status": 503} else {"method": "PUT"}
        server.fail(1000, **fault, **place)
        with pytest.raises(OutputError, match=message):
            try_claim(store, "a")
        server.forgive()
        assert store.list("") == {}
