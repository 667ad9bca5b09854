"""Claims: one holder at a time, whoever contends, however the last one ended."""

import contextlib
import fcntl
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import claim_holder
import pytest
from claim_holder import PATIENT, TIMES, contend
from s3_server import s3_server

from augment.batch import remote_claims
from augment.batch.claims import CLAIMS_FOLDER, ClaimTimes, try_claim
from augment.batch.local_claims import try_lock
from augment.batch.remote_store import Patience, RemoteStore
from augment.batch.store import open_store
from augment.errors import OutputError


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


def test_threads_and_processes_contend(store, tmp_path):
    rounds, log = 10 if store.local_dir else 2, str(tmp_path / "held")
    arguments = ("contend", store.uri, "a", str(rounds), log)
    with other_process(*arguments) as first, ThreadPoolExecutor(2) as pool:
        threads = [pool.submit(contend, store.uri, "a", rounds, log) for _ in range(2)]
        for thread in threads:
            thread.result()
        assert first.wait(60) == 0
    assert store.list("") == {}


def test_locally_a_dead_process_is_followed_at_once(tmp_path):
    store = open_store(tmp_path)
    with other_process("hold", store.uri, "a") as holder:
        assert holder.stdout.readline() == "holding\n"
        assert try_claim(store, "a") is None
        holder.kill()
        holder.wait()
        with try_claim(store, "a") as claim:
            claim.check()


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


def test_remotely_a_dead_process_is_followed_after_its_lifetime(remote):
    with other_process("hold", remote.uri, "dead") as holder:
        assert holder.stdout.readline() == "holding\n"
        with try_claim(remote, "alive", TIMES) as alive:
            holder.kill()
            holder.wait()
            assert try_claim(remote, "dead", TIMES) is None
            deadline_s = time.monotonic() + 30
            while (claim := try_claim(remote, "dead", TIMES)) is None:
                assert time.monotonic() < deadline_s
                time.sleep(0.1)
            # As old as the dead one, and renewed.
            assert try_claim(remote, "alive", TIMES) is None
            alive.check()
            claim.release()


def test_claims_end_with_the_process(server, remote):
    with other_process("leave", remote.uri, "a") as process:
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
    with try_claim(remote, "a", TIMES) as claim:
        remote.delete(remote.list(CLAIMS_FOLDER))
        time.sleep(3 * TIMES.renewal_s)
        assert remote.list(CLAIMS_FOLDER) == {}
        with pytest.raises(OutputError, match="object was deleted"):
            claim.check()


def test_claims_that_cannot_be_renewed_are_lost(server, remote, caplog):
    with try_claim(remote, "a", TIMES) as claim:
        server.fail(1000, status=503)
        claim._thread.join(30)
        assert not claim._thread.is_alive()
        server.forgive()
        with pytest.raises(OutputError, match="not renewed"):
            claim.check()
    assert "a claim was not renewed: cannot" in caplog.text


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
    clock_s = iter([0.0, TIMES.lifetime_s + 1, 0.0, TIMES.lifetime_s + 1])
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


def test_releasing_ends_the_thread(remote):
    for _ in range(3):
        try_claim(remote, "a", PATIENT).release()
    assert not [thread for thread in threading.enumerate() if "renews" in thread.name]
