"""One process at a time at one piece of an output, among processes and machines.

On a local store a claim is the kernel's lock of a file (flock): it ends with the process, and with
the children that it forked, however they end.

On a remote store a claim is an object, made by a put that fails where there is one. A thread renews
it by puts that fail where it is no longer as this process left it. One that was not renewed for the
lifetime, by the clock of the store, is dead, and whoever replaces that version of it holds the
claim. So of all who contend the store refuses all but one.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import json
import logging
import math
import os
import secrets
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from augment.errors import OutputError
from augment.jobs.atomic import is_named, open_lock, path_below, refusals_of
from augment.jobs.layout import STATE_FOLDER, folder_name
from augment.jobs.store import RemoteStore, Store, StoredVersion

CLAIMS_FOLDER = f"{STATE_FOLDER}/claims"
_FIRST_WAIT_S = 0.05  # between the first two looks at a claim that another process holds
_MAX_WAIT_S = 0.5  # between later ones
_SAY_AFTER_S = 2.0  # of waiting
_log = logging.getLogger(__name__)


class Claim(ABC):
    """Held by this process until released; leaving its `with` block releases it."""

    @abstractmethod
    def check(self) -> None:
        """Make sure that it is still held."""

    @abstractmethod
    def release(self) -> None:
        """Give it up, for others to take; a second time, or in a forked child, does nothing."""

    def __enter__(self) -> Claim:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


@dataclass(frozen=True)
class ClaimTimes:
    """How often a remote claim is renewed, and when one counts as dead, which must be several times
    later.
    """

    renewal_s: float = 20.0
    lifetime_s: float = 90.0


CLAIM_TIMES = ClaimTimes()


def try_claim(store: Store, name: str, times: ClaimTimes | None = None) -> Claim | None:
    """The claim of that name, or None: a live process, here or elsewhere, holds it. The name is one
    component of a path: letters, digits, `.`, `_`, `-` (see layout.folder_name). Raises
    OutputError: the store cannot be read or written. ValueError: another name.
    """
    if folder_name(name) != name:
        raise ValueError(
            f"a claim's name must be letters, digits, '.', '_' and '-', at most 100 of them, the "
            f"first a letter or digit; got {name!r}. layout.folder_name makes such names"
        )
    if store.local_dir is not None:
        return try_lock(path_below(store.local_dir, (CLAIMS_FOLDER,)) / f"{name}.lock")
    assert isinstance(store, RemoteStore), "a claim elsewhere needs conditional puts"
    return _contend(store, f"{CLAIMS_FOLDER}/{name}", times or CLAIM_TIMES)


@contextlib.contextmanager
def hold(
    store: Store, name: str, patience_s: float = 120.0, doing: str = "writes there"
) -> Iterator[Claim]:
    """Be inside with the claim; waits for others that are, and says so once. doing: what they do,
    after "another process". Raises OutputError: one of them takes longer than the patience.
    """
    started, wait_s, is_said = time.monotonic(), _FIRST_WAIT_S, False
    while (claim := try_claim(store, name)) is None:
        waited_s = time.monotonic() - started
        if waited_s > patience_s:
            raise OutputError(
                f"{store.uri}: another process has held the claim {name!r} for {patience_s:.0f} s; "
                f"end it, then run the same command again"
            )
        if waited_s > _SAY_AFTER_S and not is_said:
            is_said = True
            _log.info(
                "%s: another process %s; waiting for its claim %r, at most %.0f min",
                *(store.uri, doing, name, patience_s / 60),
            )
        time.sleep(wait_s)
        wait_s = min(2 * wait_s, _MAX_WAIT_S)
    with claim:
        yield claim


# ---- Among the processes of one machine ----------------------------------------------------------
# Not by filelock, which leaves the file where it is and does not notice that somebody deleted it.

_MAX_RACES = 1000  # times that the file is deleted by its holder while it is being opened


class FileClaim(Claim):
    """A locked file, deleted by its holder while it holds it."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._descriptor = descriptor
        self._process = os.getpid()

    def check(self) -> None:
        if self._descriptor < 0 or not is_named(self._path, self._descriptor):
            raise OutputError(
                f"the claim {self._path} is lost: its file was deleted or the claim released. Do "
                f"not delete {self._path.parent} while jobs are running; run the same command again"
            )

    def release(self) -> None:
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor < 0 or self._process != os.getpid():
            return
        # First the name: after it, nobody else can open this file, and who has opened it already
        # sees that it has no name and opens the next one.
        try:
            with refusals_of(self._path):
                if is_named(self._path, descriptor):
                    self._path.unlink(missing_ok=True)
                    with contextlib.suppress(OSError):  # where there are no others
                        self._path.parent.rmdir()
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # for forked children too
            os.close(descriptor)


def try_lock(path: Path) -> FileClaim | None:
    """Lock the file, which is made if missing; None where another process holds it."""
    with refusals_of(path):
        for _ in range(_MAX_RACES):
            with contextlib.ExitStack() as stack:
                try:
                    descriptor = open_lock(path)
                except OutputError as error:
                    if isinstance(error.__cause__, FileNotFoundError):  # its folder was deleted
                        continue
                    raise
                stack.callback(os.close, descriptor)
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    return None
                if is_named(path, descriptor):  # else a holder has deleted it since
                    stack.pop_all()
                    return FileClaim(path, descriptor)
    return None


# ---- Among machines that share nothing but a remote store ----------------------------------------

_RESOLUTION_S = 1.0  # of the times that stores tell
_CLOCK_AGE_S = 600.0  # after which the store's clock is read again
_clocks: dict[str, tuple[float, float]] = {}  # by URI: when it was read, and how far it is ahead


class _ObjectClaim(Claim):
    """An object that a thread renews."""

    def __init__(
        self,
        store: RemoteStore,
        path: str,
        times: ClaimTimes,
        owner: str,
        there: StoredVersion,
        renewed_s: float,
    ) -> None:
        """renewed_s: before the object was last written, by this machine's clock."""
        self._store, self._path, self._times = store, path, times
        self._owner, self._there, self._renewed_s = owner, there, renewed_s
        self._lost = ""
        self._process = os.getpid()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._keep_renewing, daemon=True)
        self._thread.start()
        atexit.register(self.release)

    def check(self) -> None:
        if self._process == os.getpid():  # a forked child does not see renewals
            self._note_age()
        if not self._lost:
            self._note_owner(self._store.read_version(self._path))
        if self._lost:
            raise OutputError(
                f"the claim {self._path} of {self._store.uri} is lost: {self._lost}. Another "
                f"process may be at work on the same files; run the same command again when it has "
                f"ended"
            )

    def release(self) -> None:
        if self._stop.is_set() or self._process != os.getpid():
            return
        atexit.unregister(self.release)
        self._stop.set()
        self._thread.join()
        try:
            # A request to delete hits whatever is there. A late one must find this claim, which
            # nobody takes over before its lifetime has passed.
            self._renew()
            left_s = self._renewed_s + self._times.lifetime_s - _clock_s()
            if not self._lost and left_s > self._store.patience.timeout_s:
                self._store.delete_once(self._path)
        except OutputError as error:
            _log.warning("a claim ends only in %.0f s: %s", self._times.lifetime_s, error)
        self._lost = self._lost or "it was released"

    def _keep_renewing(self) -> None:
        while not self._lost and not self._stop.wait(self._times.renewal_s):
            try:
                self._renew()
            except OutputError as error:
                _log.warning("a claim was not renewed: %s", error)
                self._note_age()

    def _renew(self) -> None:
        started_s = _clock_s()
        for _ in range(2):  # a renewal that was thought to have failed may have arrived since
            if self._lost:
                return
            data = _record(self._owner)
            there = self._store.put_if(self._path, data, self._there)
            self._note_owner(there)
            self._there = there or self._there
            if self._there.data == data:
                self._renewed_s = started_s
                return

    def _note_owner(self, there: StoredVersion | None) -> None:
        if there is None:
            self._lost = "its object was deleted"
        elif not _is_of(self._owner, there):
            self._lost = "another process took it over"

    def _note_age(self) -> None:
        age_s = _clock_s() - self._renewed_s
        if age_s > self._times.lifetime_s and not self._lost:
            self._lost = (
                f"it was not renewed for {age_s:.0f} s, and counts as given up after "
                f"{self._times.lifetime_s:.0f} s"
            )


def _contend(store: RemoteStore, path: str, times: ClaimTimes) -> _ObjectClaim | None:
    """Try to become the holder; None where another one lives."""
    owner, there = secrets.token_hex(8), None
    _store_clock_s(store)
    for _ in range(_MAX_RACES):
        started_s = _clock_s()
        there = store.put_if(path, _record(owner), there)
        if there is None:  # released meanwhile
            continue
        if _is_of(owner, there):
            is_fresh = _clock_s() - started_s < times.lifetime_s
            return _ObjectClaim(store, path, times, owner, there, started_s) if is_fresh else None
        if _store_clock_s(store) - there.modified_s <= times.lifetime_s + _RESOLUTION_S:
            return None
        _log.warning("%s: taking over %s from a process that has died", store.uri, path)
    return None


def _record(owner: str) -> bytes:
    """Of the holder; never the same bytes twice, so no two versions are taken for one."""
    who = {"owner": owner, "host": socket.gethostname(), "process": os.getpid()}
    return json.dumps(who | {"put": secrets.token_hex(8)}).encode()


def _is_of(owner: str, there: StoredVersion) -> bool:
    return owner.encode() in there.data


def _store_clock_s(store: RemoteStore) -> float:
    """A time that the store's clock has passed, read by means of an object of a moment. Raises
    OutputError: the store puts objects where it should refuse.
    """
    read_s, ahead_s = _clocks.get(store.uri, (-math.inf, 0.0))
    if _clock_s() - read_s > _CLOCK_AGE_S:
        path = f"{STATE_FOLDER}/clock/{secrets.token_hex(8)}"
        first = store.put_if(path, b"1", None)
        store.put_if(path, b"2", first)
        read_s = _clock_s()
        there = [store.put_if(path, b"3", first), store.put_if(path, b"4", None)]
        store.delete([path])
        if there[0] is None or [version and version.data for version in there] != [b"2", b"2"]:
            raise OutputError(
                f"{store.uri}: this store ignores If-None-Match or If-Match, so several processes "
                f"cannot share an output there; use another store, or a folder of this machine"
            )
        ahead_s = there[0].modified_s - read_s
        _clocks[store.uri] = (read_s, ahead_s)
    return _clock_s() + ahead_s


def _clock_s() -> float:
    """Seconds that go on while the machine sleeps, where the system has such a clock."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))
