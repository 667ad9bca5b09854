"""A remote store while its server fails: files are whole, or as they were, never cut short."""

import http.client
import multiprocessing
import pickle
import signal
import threading
import time

import pytest
from s3_server import s3_server

from augment.errors import OutputError
from augment.jobs.store import Patience, RemoteStore, StoredFileMissing, open_store

BIG = b"0123456789" * 1_100_000  # three parts of an upload
QUICK = Patience(3, 0.001, timeout_s=5.0)
TRIES = QUICK.retries + 1
FAULTS = [{"status": 500}, {"status": 503}, {"cut": "upload"}, {"cut": "answer"}]


@pytest.fixture(scope="module")
def shared_server():
    with s3_server() as server:
        yield server


@pytest.fixture
def server(shared_server):
    shared_server.forgive()
    return shared_server


@pytest.fixture
def store(server, request):
    return RemoteStore(server.uri(request.node.name.replace(" ", "-").strip("[]")), QUICK)


@pytest.mark.parametrize("fault", FAULTS)
def test_writes_arrive_after_failures_or_leave_what_was_there(server, store, fault):
    store.write("a", b"the old one")
    server.fail(TRIES - 1, method="PUT", **fault)
    store.write("a", b"the new one, longer")
    assert store.read("a") == b"the new one, longer"
    server.fail(TRIES, method="PUT", **fault)
    with pytest.raises(OutputError, match=r"cannot write s3://.*/a: .*after 3 retries"):
        store.write("a", b"the third one, and longer still")
    server.forgive()
    has_arrived = fault == {"cut": "answer"}
    expected = b"the third one, and longer still" if has_arrived else b"the new one, longer"
    assert store.read("a") == expected


def test_uploads_in_parts_are_whole(server, store):
    store.write("a", b"the old one")
    server.fail(1, method="PUT", path="partNumber=1", status=403)
    with pytest.raises(OutputError, match="privileges"):
        store.write("a", BIG)
    assert store.read("a") == b"the old one"
    server.fail(1, method="PUT", path="partNumber=1", cut="upload")
    store.write("a", BIG)
    assert store.read("a") == BIG


def test_other_operations_outlast_failures(server, store):
    store.write("a/b", b"1")
    server.fail(3, status=500)
    assert store.read("a/b") == b"1"
    server.fail(1, method="GET", cut="answer")
    assert store.read("a/b") == b"1"
    server.fail(3, status=503)
    assert list(store.list("a")) == ["a/b"]
    server.fail(3, cut="answer")
    assert store.exists("a/b")
    server.fail(1, method="DELETE", cut="answer")
    store.delete(["a/b"])
    assert not store.exists("a/b")


def test_a_server_that_stands_still_is_left(server, store):
    store.write("a", b"1")
    impatient = RemoteStore(store.uri, Patience(6, 0.001, timeout_s=1.0))
    server.fail(1, method="PUT", delay_s=1.6, status=500)
    impatient.write("a", b"2")
    assert store.read("a") == b"2"


@pytest.mark.parametrize("status", [400, 401, 403])
def test_refusals_are_not_repeated(server, store, status):
    store.write("a", b"1")
    before = len(server.requests)
    server.fail(10, status=status)
    with pytest.raises(OutputError, match=r"cannot write [^;]*; .*check") as caught:
        store.write("a", b"2")
    assert len(server.requests) == before + 1
    assert "retries" not in str(caught.value)
    assert ("AWS_ACCESS_KEY_ID" in str(caught.value)) == (status != 400)


def test_buckets_must_exist(server):
    store = RemoteStore(server.uri("out").replace(server.bucket, "none"), QUICK)
    for call in (lambda: store.read("a"), lambda: store.list(""), lambda: store.write("a", b"")):
        with pytest.raises(OutputError, match="NoSuchBucket; check the bucket's name") as caught:
            call()
        assert not isinstance(caught.value, StoredFileMissing)


def test_nobody_answers(server):
    store = RemoteStore("s3://bucket/out?endpoint_override=127.0.0.1:1&scheme=http", QUICK)
    with pytest.raises(OutputError, match=r"list s3://bucket/out: .*3 retries.*AWS_ENDPOINT_URL"):
        store.list("")


def test_options_go_before_the_environment(server, monkeypatch):
    for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3"):
        monkeypatch.setenv(name, "http://127.0.0.1:1")
    store = RemoteStore(server.uri("out"), QUICK)
    store.write("a", b"1")
    assert store.read("a") == b"1"
    uri = "s3://box/out?endpoint_override=nowhere.invalid&force_virtual_addressing=true"
    with pytest.raises(OutputError, match=r"https://box\.nowhere\.invalid"):
        RemoteStore(uri, QUICK).list("")
    with pytest.raises(OutputError, match=r"cannot read /none\.pem"):
        open_store(f"{store.uri}&tls_ca_file_path=/none.pem").list("")


def test_credentials_stay_inside(server):
    secret = "pass/word%2Bplus"
    store = RemoteStore(server.uri("out", credentials="someone:pass%2Fword%252Bplus@"), QUICK)
    store.write("a", b"1")
    assert pickle.loads(pickle.dumps(store)).read("a") == b"1"
    server.fail(4, status=500)
    with pytest.raises(OutputError) as caught:
        store.write("someone", b"1")
    texts = [store.uri, repr(store), str(caught.value)]
    for text in texts:
        assert "pass" not in text and secret not in text
    assert "someone" not in store.uri and caught.value.__cause__ is None
    assert open_store(store.uri).read("a") == b"1"
    for uri in ("abfs://box@account.dfs.core.windows.net/y", "gs://anonymous@bucket/x"):
        assert open_store(uri).uri == uri


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("s4a://bucket/x", "no stores of the kind 's4a'"),
        ("hdfs://host/x", "no stores of the kind 'hdfs'"),
        ("http://host/x", "no stores of the kind 'http'"),
        ("s3:///x", "no bucket"),
        ("s3://bucket/a/../b", "without"),
        ("s3://bucket/a/%2e%2e/b", "without"),
        ("s3://bucket/a#b", "without"),
        ("s3://bucket//b", "without"),
        ("s3://bucket/x?regoin=eu", "no option 'regoin'.*region"),
        ("s3://me:word@bucket/x?access_key=word", "^[^w]*no option 'access_key'"),
        ("s3://me:word@bucket/x?region", "^[^w]*no URI"),
        ("s3://me:word@[bucket/x", "^[^w]*no URI"),
        ("gs://me:word@bucket/x", "^[^w]*no option 'user@'"),
        ("az://box:word@account/x", "^[^w]*no option 'user@'"),
        ("abfs://box@account.x/y?account_key=word", "^[^w]*no option 'account_key'"),
    ],
)
def test_wrong_uris(uri, message):
    with pytest.raises(OutputError, match=f"(?i){message}"):
        open_store(uri)


def test_what_others_left_is_not_listed_or_named(server, store):
    def put(key):
        path, _, _ = store.uri.removeprefix("s3:/").partition("?")
        connection = http.client.HTTPConnection(server.endpoint)
        connection.request("PUT", f"{path}/{key}", body=b"")
        assert connection.getresponse().status == 200
        connection.close()

    for marker in ("", "good/"):  # of folders
        put(marker)
    store.write("good/b", b"")
    assert list(store.list("")) == list(store.list("good")) == ["good/b"]
    put("a//b")
    put("a%01b")
    with pytest.raises(OutputError, match="delete what others have put there"):
        store.list("")


def test_unreadable_sources_send_nothing(server, store, tmp_path):
    store.write("a", b"1")
    before = len(server.requests)
    with pytest.raises(OutputError, match="Is a directory"):
        store.put_file("a", tmp_path)
    assert len(server.requests) == before


def test_interrupts_wait_for_the_upload(server, store):
    store.write("a", b"1")
    server.fail(1, method="PUT", delay_s=0.3)
    before = len(server.requests)

    def interrupt():
        while len(server.requests) == before:
            time.sleep(0.01)
        signal.raise_signal(signal.SIGINT)

    interrupter = threading.Thread(target=interrupt)
    interrupter.start()
    with pytest.raises(KeyboardInterrupt):
        store.write("a", b"22")
    interrupter.join()
    assert store.read("a") == b"22"


def _in_child(store, connection, generations):
    store.write("from/child", b"2")
    if generations > 1:
        _fork(store, connection, generations - 1)
    else:
        connection.send(store.read("from/parent"))


def _fork(store, connection, generations):
    arguments = (store, connection, generations)
    child = multiprocessing.get_context("fork").Process(target=_in_child, args=arguments)
    child.start()
    child.join(60)
    assert child.exitcode == 0


def test_forked_children_open_their_own(server, store):
    store.write("from/parent", b"1")
    receiver, sender = multiprocessing.Pipe(duplex=False)
    _fork(store, sender, 2)
    assert receiver.poll(0) and receiver.recv() == b"1"
    assert store.read("from/child") == b"2"


def test_threads_share_a_store(server, store):
    names = [f"t/{number:02}" for number in range(8)]
    threads = [threading.Thread(target=store.write, args=(name, name.encode())) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert list(store.list("t")) == names
    store.delete(names)
    assert store.list("t") == {}
