"""A remote store while its server fails: files are whole, or as they were, never cut short."""

import multiprocessing
import pickle
import signal
import threading
import time

import pytest
from s3_server import s3_server

from augment.errors import OutputError
from augment.jobs.store import Patience, RemoteStore, StoredFileMissing, open_store

BIG = b"0123456789" * 1_100_000  # two parts of an upload
QUICK = Patience(attempts=4, first_wait_s=0.001, longest_wait_s=0.002, timeout_s=5.0)
FAULTS = {
    "500": {"status": 500},
    "503": {"status": 503},
    "cut in the middle": {"cut": "upload"},
    "cut before the answer": {"cut": "answer"},
    "half is stored": {"truncate": True},
}


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


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS.keys())
def test_writes_arrive_after_failures(server, store, fault):
    store.write("a", b"the old one")
    server.fail(QUICK.attempts - 1, method="PUT", **fault)
    store.write("a", b"the new one, longer")
    assert store.read("a") == b"the new one, longer"


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS.keys())
def test_writes_that_fail_for_good_store_no_part(server, store, fault):
    store.write("a", b"the old one")
    server.fail(QUICK.attempts, method="PUT", **fault)
    with pytest.raises(
        OutputError, match=rf"cannot write {store.uri[:8]}.*/a.* after 4 attempts: "
    ):
        store.write("a", b"the new one, longer")
    server.forgive()
    if fault == {"truncate": True}:  # nobody's file
        assert not store.exists("a")
    elif fault == {"cut": "answer"}:  # it had arrived
        assert store.read("a") == b"the new one, longer"
    else:
        assert store.read("a") == b"the old one"


def test_uploads_in_parts_are_whole(server, store):
    """With other settings pyarrow completes an upload without the part that failed."""
    store.write("a", b"the old one")
    server.fail(1, method="PUT", path="partNumber=1", status=403)
    with pytest.raises(OutputError, match="ACCESS_DENIED"):
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
    impatient = RemoteStore(store.uri, Patience(6, 0.001, 0.001, timeout_s=1.0))
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
    assert "attempts" not in str(caught.value)
    assert ("AWS_ACCESS_KEY_ID" in str(caught.value)) == (status != 400)


def test_buckets_must_exist(server):
    store = RemoteStore(server.uri("out").replace(server.bucket, "none"), QUICK)
    before = len(server.requests)
    calls = [lambda: store.read("a"), lambda: store.list(""), lambda: store.write("a", b"")]
    for call in calls:
        with pytest.raises(
            OutputError, match="no bucket 'none'; check the bucket's name"
        ) as caught:
            call()
        assert not isinstance(caught.value, StoredFileMissing)
    assert len(server.requests) == before + len(calls)


def test_nobody_answers():
    store = RemoteStore("s3://bucket/out?endpoint_override=127.0.0.1:1&scheme=http", QUICK)
    with pytest.raises(OutputError, match=r"list s3://bucket/out .*4 attempts: .*AWS_ENDPOINT_URL"):
        store.list("")


def test_credentials_stay_inside(server):
    secret = "pass/word%2Bplus"
    store = RemoteStore(server.uri("out", credentials="someone:pass%2Fword%252Bplus@"), QUICK)
    store.write("a", b"1")
    assert pickle.loads(pickle.dumps(store)).read("a") == b"1"
    server.fail(4, status=500)
    with pytest.raises(OutputError) as caught:
        store.write("someone", b"1")
    texts = [store.uri, repr(store), repr(store._place), str(caught.value)]
    for text in texts:
        assert "pass" not in text and secret not in text
    assert "someone" not in store.uri and caught.value.__cause__ is None
    assert open_store(store.uri).read("a") == b"1"
    signed = open_store("abfs://box@account.x/y?account_key=abc123&blob_storage_scheme=https")
    assert signed.uri == "abfs://box@account.x/y?blob_storage_scheme=https"
    assert open_store("gs://anonymous@bucket/x").uri == "gs://anonymous@bucket/x"


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("s4a://bucket/x", "no stores of the kind 's4a'"),
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
    ],
)
def test_wrong_uris(uri, message):
    with pytest.raises(OutputError, match=f"(?i){message}"):
        open_store(uri)


def test_what_others_left_is_not_listed(server, store):
    system = store._system()
    for path in ("a\\b", "a\x7fb"):
        with system.open_output_stream(path) as stream:
            stream.write(b"")
    store.write("good/a", b"")
    store.delete(["good/a"])  # leaves a marker of the folder
    store.write("good/b", b"")
    assert list(store.list("")) == ["good/b"]


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


def _in_child(store, connection):
    store.write("from/child", b"2")
    connection.send(store.read("from/parent"))


def test_forked_children_open_their_own(server, store):
    store.write("from/parent", b"1")
    parents = store._system()
    receiver, sender = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=_in_child, args=(store, sender))
    child.start()
    assert receiver.poll(30) and receiver.recv() == b"1"
    child.join(30)
    assert child.exitcode == 0
    assert store._system() is parents
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
