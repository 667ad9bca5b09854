"""Claims: one holder at a time, whoever contends, however the last one ended."""

import contextlib
import fcntl
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import claim_holder
import pytest
from claim_holder import PATIENT, contend
from s3_server import s3_server

from augment.errors import OutputError
from augment.jobs import claims as remote_claims
from augment.jobs.claims import CLAIMS_FOLDER, ClaimTimes, try_claim, try_lock
from augment.jobs.store import Patience, RemoteStore, open_store

OFTEN = ClaimTimes(renewal_s=0.05, lifetime_s=60.0)


@pytest.fixture(scope="module")
def server():
    with s3_server() as server:
        yield server


@pytest.fixture
def remote(server, tmp_path):
    server.forgive()
    return RemoteStore(server.uri(tmp_path.name), Patience(2, 0.001, 0.002))


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


class Aged:
    """The store as it will be when what it holds now has grown old; new objects are new."""

    def __init__(self, store, age_s):
        self._store, self._age_s, self._old = store, age_s, set(store.list(""))

    def __getattr__(self, name):
        return getattr(self._store, name)

    def list(self, folder):
        found = self._store.list(folder)
        for path in self._old & found.keys():
            found[path] = replace(found[path], modified_s=found[path].modified_s - self._age_s)
        return found


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
    for age_s in (0, PATIENT.lifetime_s - 30):
        assert try_claim(Aged(remote, age_s), "a", PATIENT) is None
    with try_claim(Aged(remote, PATIENT.lifetime_s + 2), "a", PATIENT) as claim:
        claim.check()
        assert len(remote.list("")) == 1
        assert try_claim(remote, "a", PATIENT) is None


def test_claims_are_renewed(server, remote):
    with try_claim(remote, "renewed", OFTEN) as claim:
        seen, deadline_s = len(server.requests), time.monotonic() + 60
        while sum("PUT" in line and "renewed" in line for line in server.requests[seen:]) < 3:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        claim.check()


def test_claims_end_with_the_process(remote):
    with other_process("leave", "a", remote.uri) as process:
        assert process.wait(60) == 0
    assert remote.list("") == {}


def test_deleted_claims_are_lost(store):
    with try_claim(store, "a", PATIENT) as claim:
        store.delete(store.list(CLAIMS_FOLDER))
        with try_claim(store, "a", PATIENT) as other:
            with pytest.raises(OutputError, match=r"lost: its .* was deleted"):
                claim.check()
            claim.release()
            other.check()


def test_a_lost_claim_is_not_renewed(remote):
    with try_claim(remote, "a", OFTEN) as claim:
        deadline_s = time.monotonic() + 60
        while claim._thread.is_alive():  # a renewal under way may bring it back
            assert time.monotonic() < deadline_s
            remote.delete(remote.list(CLAIMS_FOLDER))
        assert remote.list(CLAIMS_FOLDER) == {}
        with pytest.raises(OutputError, match="object was deleted"):
            claim.check()


def test_claims_that_cannot_be_renewed_are_lost(server, remote, caplog, monkeypatch):
    with try_claim(remote, "a", OFTEN) as claim:
        server.fail(1000, status=503)
        deadline_s = time.monotonic() + 60
        while "a claim was not renewed: cannot" not in caplog.text:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        now_s = remote_claims._clock_s()
        monkeypatch.setattr(remote_claims, "_clock_s", lambda: now_s + OFTEN.lifetime_s + 1)
        claim._thread.join(60)
        assert not claim._thread.is_alive()
        server.forgive()
        with pytest.raises(OutputError, match="not renewed"):
            claim.check()


def test_a_renewal_that_comes_too_late_is_taken_back(remote, monkeypatch):
    """While it was under way, others may have taken the claim."""
    with try_claim(remote, "a", PATIENT) as claim:
        now_s = remote_claims._clock_s()
        monkeypatch.setattr(remote_claims, "_clock_s", lambda: now_s + PATIENT.lifetime_s + 1)
        claim._renew()
        assert remote.list(CLAIMS_FOLDER) == {}
        with pytest.raises(OutputError, match=r"not renewed for 6\d s, and counts as given up"):
            claim.check()


def test_a_contender_that_stood_still_withdraws(remote, monkeypatch):
    clock_s = iter([0.0, 1.0, 0.0, 1.0])
    monkeypatch.setattr(remote_claims, "_clock_s", lambda: next(clock_s))
    assert try_claim(remote, "a", ClaimTimes(0.1, 0.5, attempts=2, longest_wait_s=0.01)) is None
    assert remote.list("") == {}


def test_contenders_that_meet_both_withdraw(remote):
    """Another one that does not yet hold it: no holder, and yet no claim."""
    remote.write(f"{CLAIMS_FOLDER}/a/other", b"")
    assert try_claim(remote, "a", PATIENT) is None
    assert list(remote.list("")) == [f"{CLAIMS_FOLDER}/a/other"]
    remote.delete([f"{CLAIMS_FOLDER}/a/other"])
    with try_claim(remote, "a", PATIENT) as claim:
        claim.check()


def test_failures_while_contending_leave_nothing(server, remote):
    server.fail(2, method="GET", status=500)
    with pytest.raises(OutputError, match="cannot list"):
        try_claim(remote, "a", PATIENT)
    assert remote.list("") == {}


def test_forked_children_do_not_release(store):
    with try_claim(store, "a", PATIENT) as claim:
        child = os.fork()
        if child == 0:
            claim.release()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        claim.check()
        assert try_claim(store, "a", PATIENT) is None
