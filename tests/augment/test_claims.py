"""Claims: one holder at a time, whoever contends, however the last one ended."""

import contextlib
import fcntl
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import claim_holder
import pytest
from claim_holder import contend
from s3_server import s3_server

from augment.errors import OutputError
from augment.jobs.claims import CLAIMS_FOLDER, ClaimTimes, try_claim, try_lock
from augment.jobs.store import Patience, RemoteStore, open_store

QUICK = Patience(2, 0.001, timeout_s=5.0)
OFTEN = ClaimTimes(renewal_s=0.05, lifetime_s=60.0)
SHORT = ClaimTimes(renewal_s=60.0, lifetime_s=1.0)


@pytest.fixture(scope="module")
def server():
    with s3_server() as server:
        yield server


@pytest.fixture
def remote(server, tmp_path):
    server.forgive()
    return RemoteStore(server.uri(tmp_path.name), QUICK)


@pytest.fixture(params=["local", "remote"])
def store(request, tmp_path):
    if request.param == "local":
        return open_store(tmp_path / "out")
    return request.getfixturevalue("remote")


@contextlib.contextmanager
def other_process(*arguments: str):
    command = [sys.executable, claim_holder.__file__, *arguments]
    root = str(Path(claim_holder.__file__).parents[2])
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": root}
    ) as process:
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
        claim.check()
    with pytest.raises(OutputError, match=r"lost: .*released"):
        claim.check()
    assert store.list("") == {}  # nothing is left behind
    claim.release()
    with try_claim(store, "a") as again:
        claim.release()  # of the first, a second time
        again.check()


@pytest.mark.parametrize("name", ["", "..", "a/b", ".hidden", "a b", "x" * 101, "manifest.parquet"])
def test_names_are_safe(store, name):
    with pytest.raises(ValueError, match="claim's name"):
        try_claim(store, name)


@pytest.mark.long
def test_threads_and_processes_contend(remote, tmp_path):
    """Three at a time on this machine, and three through the server."""
    local = open_store(tmp_path / "out")
    places = [local.uri, "10", str(tmp_path / "log"), remote.uri, "2", str(tmp_path / "remote log")]
    with other_process("contend", "a", *places) as other, ThreadPoolExecutor(2) as pool:
        assert other.stdout.readline() == "contending\n"
        threads = [pool.submit(contend, "a", places) for _ in range(2)]
        for thread in threads:
            thread.result()
        assert other.wait(60) == 0
    assert remote.list("") == local.list("") == {}


def test_a_lock_file_that_changes_hands_while_it_is_opened(tmp_path, monkeypatch):
    """Its holder deletes it, and another one makes and locks the next file of that name."""
    path, flock, others = tmp_path / "a.lock", fcntl.flock, []

    def flock_too_late(descriptor, operation):
        monkeypatch.setattr(fcntl, "flock", flock)
        path.unlink()
        others.append(try_lock(path))
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", flock_too_late)
    assert try_lock(path) is None
    others[0].check()
    others[0].release()
    with try_lock(path) as claim:
        claim.check()


def test_a_dead_process_is_followed(remote, tmp_path):
    """At once on this machine, after its lifetime elsewhere."""
    local = open_store(tmp_path)
    with other_process("hold", "a", local.uri, remote.uri) as holder:
        assert holder.stdout.readline() == "holding\n"
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


def test_of_two_who_find_a_dead_claim_one_takes_it_over(server, remote):
    remote.write(f"{CLAIMS_FOLDER}/a", b"of a dead process")
    time.sleep(3.1)  # its lifetime, and what the store's clock may err by
    server.fail(2, method="GET", path="claims/a", delay_s=0.3)  # both see it before either acts
    with ThreadPoolExecutor(2) as pool:
        claims = list(pool.map(lambda _: try_claim(remote, "a", SHORT), range(2)))
    (claim,) = filter(None, claims)
    claim.release()


def test_claims_are_renewed(server, remote):
    with try_claim(remote, "renewed", OFTEN) as claim:
        seen = len(server.requests)
        wait_for(lambda: str(server.requests[seen:]).count("claims/renewed") > 2)
        claim.check()


def test_claims_end_with_the_process(remote):
    with other_process("leave", "a", remote.uri) as process:
        assert process.wait(60) == 0
    assert remote.list("") == {}


def test_deleted_claims_are_lost(store):
    with try_claim(store, "a") as claim:
        store.delete(store.list(CLAIMS_FOLDER))
        with try_claim(store, "a") as other:
            with pytest.raises(OutputError, match=r"lost: (its .* was deleted|another process)"):
                claim.check()
            claim.release()
            other.check()


def test_a_lost_claim_is_not_renewed(remote):
    with try_claim(remote, "a", OFTEN) as claim:
        remote.delete(remote.list(CLAIMS_FOLDER))
        time.sleep(0.3)
        assert remote.list(CLAIMS_FOLDER) == {}
        with pytest.raises(OutputError, match="object was deleted"):
            claim.check()


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


def test_a_renewal_that_arrives_late_is_the_holders(server, remote):
    impatient = RemoteStore(remote.uri, Patience(0, 0.001, timeout_s=0.5))
    with try_claim(impatient, "a", ClaimTimes(0.1, 60.0)) as claim:
        server.fail(2, method="PUT", path="claims/a", delay_s=0.8)
        wait_for(lambda: not any(fault.left for fault in server._faults))
        time.sleep(1.5)
        claim.check()
    assert remote.list("") == {}


def test_a_late_deletion_hits_no_other_claim(server, remote):
    impatient = RemoteStore(remote.uri, Patience(2, 0.001, timeout_s=0.5))
    claims = [try_claim(impatient, "a")]
    server.fail(1, method="DELETE", path="claims/a", delay_s=0.8)
    claims[0].release()
    wait_for(lambda: claims.append(try_claim(remote, "a")) or claims[-1])
    time.sleep(1.0)
    with claims[-1]:
        claims[-1].check()


def test_failures_while_contending_end_in_an_error(server, remote):
    server.fail(1000, path="claims/a", status=503)
    with pytest.raises(OutputError, match=r"cannot read .*claims/a.*run the same command again"):
        try_claim(remote, "a")
    server.forgive()
    with try_claim(remote, "a"):
        pass


@pytest.mark.parametrize("header", ["HTTP_IF_NONE_MATCH", "HTTP_IF_MATCH"])
def test_stores_without_conditional_puts_are_refused(server, remote, header):
    server.fail(1000, method="PUT", ignore=header)
    with pytest.raises(OutputError, match="ignores If-None-Match or If-Match"):
        try_claim(remote, "a")
    assert remote.list("") == {}
    server.forgive()
    server.fail(1000, method="PUT", status=501)
    with pytest.raises(OutputError, match=r"needs? puts with If-None-Match"):
        try_claim(remote, "a")


def test_forked_children_do_not_release(store):
    with try_claim(store, "a") as claim:
        child = os.fork()
        if child == 0:
            claim.release()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        claim.check()
        assert try_claim(store, "a") is None
