"""Claims: only one process at a time works on a piece of an output, among processes and machines.

In: a store and the name of a claim. Out: the claim, or None while another process holds it. Workers
claim blocks of images, and writers claim the manifest.

On a local store a claim is the kernel's lock of a file (flock). It ends with the process and with
the children that it forked, however they end.

On a remote store a claim is an object, made by a put that fails where the object exists. A thread
renews it by puts that fail where the object has been changed by another process. A claim that was
not renewed for its lifetime, by the clock of the store, is dead. The process that then replaces
that version of the object holds the claim; the store refuses all other processes that try.
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
from augment.output.atomic import is_named, open_lock, path_below, raise_output_error
from augment.output.names import STATE_FOLDER, folder_name
from augment.output.store import RemoteStore, Store, StoredVersion

# Folder of the claims.
CLAIMS_FOLDER = f"{STATE_FOLDER}/claims"
# Time between the first two looks at a claim that another process holds, seconds.
_FIRST_WAIT_S = 0.05
# Longest time between two looks, seconds.
_MAX_WAIT_S = 0.5
# Wait after which a message says so, seconds.
_LOG_AFTER_S = 2.0
_log = logging.getLogger(__name__)


class Claim(ABC):
    """Claim that this process holds until it is released; leaving its `with` block releases it."""

    @abstractmethod
    def check(self) -> None:
        """Raise OutputError unless this process still holds the claim."""

    @abstractmethod
    def release(self) -> None:
        """Release the claim; does nothing a second time, or in a forked child."""

    def __enter__(self) -> Claim:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


@dataclass(frozen=True)
class ClaimTimes:
    """Times of a remote claim."""

    renewal_s: float = 20.0
    """Time between two renewals, seconds."""
    lifetime_s: float = 90.0
    """Age from which a claim that was not renewed counts as dead, seconds; several times the
    renewal time.
    """


# Times of claims of jobs.
CLAIM_TIMES = ClaimTimes()


def try_claim(store: Store, name: str, times: ClaimTimes | None = None) -> Claim | None:
    """Return the claim of that name, or None while a live process holds it.

    The name is one component of a path: letters, digits, `.`, `_`, `-` (see layout.folder_name).

    Args:
        name: One component of a path: letters, digits, `.`, `_`, `-` (see layout.folder_name).

    Raises:
        OutputError: The store cannot be read or written.
        ValueError: The name is not such a component.
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
def hold_claim(
    store: Store, name: str, patience_s: float = 120.0, activity: str = "writes there"
) -> Iterator[Claim]:
    """Context manager that holds a claim; waits for other holders, and logs that once.

    Args:
        patience_s: Longest wait, seconds.
        activity: What the holders do, after "another process".

    Raises:
        OutputError: Another process holds the claim for longer than that.
    """
    start_s = time.monotonic()
    wait_s = _FIRST_WAIT_S
    is_logged = False
    while (claim := try_claim(store, name)) is None:
        waited_s = time.monotonic() - start_s
        if waited_s > patience_s:
            raise OutputError(
                f"{store.uri}: another process has held the claim {name!r} for {patience_s:.0f} s; "
                f"end it, then run the same command again"
            )
        if waited_s > _LOG_AFTER_S and not is_logged:
            is_logged = True
            _log.info(
                "%s: another process %s; waiting for its claim %r, at most %.0f min",
                store.uri,
                activity,
                name,
                patience_s / 60,
            )
        time.sleep(wait_s)
        wait_s = min(2 * wait_s, _MAX_WAIT_S)
    with claim:
        yield claim


# ---- Among the processes of one machine ----------------------------------------------------------
# The package filelock leaves the file behind, and does not notice that its file was deleted.

# Times that the file may be deleted by its holder while it is being opened.
_MAX_RACES = 1000


class FileClaim(Claim):
    """Claim of a locked file, which its holder deletes while it still holds the lock."""

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
        descriptor = self._descriptor
        self._descriptor = -1
        if descriptor < 0 or self._process != os.getpid():
            return
        # The name goes first: then no other process can open this file, and a process that has
        # opened it already sees that it has no name, and opens the next one.
        try:
            with raise_output_error(self._path):
                if is_named(self._path, descriptor):
                    self._path.unlink(missing_ok=True)
                    with contextlib.suppress(OSError):  # fails while there are other claims
                        self._path.parent.rmdir()
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # for forked children too
            os.close(descriptor)


def try_lock(path: Path) -> FileClaim | None:
    """Lock the file, which is made if missing; return None where another process holds it."""
    with raise_output_error(path):
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
                if is_named(path, descriptor):  # otherwise a holder has deleted it meanwhile
                    stack.pop_all()
                    return FileClaim(path, descriptor)
    return None


# ---- Among machines that share nothing but a remote store ----------------------------------------

# Resolution of the times that stores tell, seconds.
_RESOLUTION_S = 1.0
# Age from which the reading of a store's clock is repeated, seconds.
_CLOCK_AGE_S = 600.0
# Time of the reading and lead over this machine's clock, both in seconds, by URI.
_clocks: dict[str, tuple[float, float]] = {}


class _ObjectClaim(Claim):
    """Claim of an object that a thread renews."""

    def __init__(
        self,
        store: RemoteStore,
        path: str,
        times: ClaimTimes,
        owner: str,
        version: StoredVersion,
        renewed_s: float,
    ) -> None:
        """Start the thread that renews the object.

        Args:
            version: The object as this process wrote it.
            renewed_s: Time before the object was last written, by this machine's clock.
        """
        self._store = store
        self._path = path
        self._times = times
        self._owner = owner
        self._version = version
        self._renewed_s = renewed_s
        self._loss_reason = ""
        self._process = os.getpid()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._keep_renewing, daemon=True)
        self._thread.start()
        atexit.register(self.release)

    def check(self) -> None:
        if self._process == os.getpid():  # a forked child does not see renewals
            self._check_age()
        if not self._loss_reason:
            self._check_owner(self._store.read_version(self._path))
        if self._loss_reason:
            raise OutputError(
                f"the claim {self._path} of {self._store.uri} is lost: {self._loss_reason}. "
                f"Another process may be at work on the same files; run the same command again "
                f"when it has ended"
            )

    def release(self) -> None:
        if self._stop.is_set() or self._process != os.getpid():
            return
        atexit.unregister(self.release)
        self._stop.set()
        self._thread.join()
        try:
            # A request to delete hits any version of the object. A late request must find this
            # claim, which no process takes over before its lifetime has passed.
            self._renew()
            left_s = self._renewed_s + self._times.lifetime_s - _clock_s()
            if not self._loss_reason and left_s > self._store.retry_settings.timeout_s:
                self._store.delete_once(self._path)
        except OutputError as error:
            _log.warning("a claim ends only in %.0f s: %s", self._times.lifetime_s, error)
        self._loss_reason = self._loss_reason or "it was released"

    def _keep_renewing(self) -> None:
        while not self._loss_reason and not self._stop.wait(self._times.renewal_s):
            try:
                self._renew()
            except OutputError as error:
                _log.warning("a claim was not renewed: %s", error)
                self._check_age()

    def _renew(self) -> None:
        start_s = _clock_s()
        for _ in range(2):  # a renewal whose answer was lost may have arrived meanwhile
            if self._loss_reason:
                return
            data = _record(self._owner)
            version = self._store.put_if(self._path, data, self._version)
            self._check_owner(version)
            self._version = version or self._version
            if self._version.data == data:
                self._renewed_s = start_s
                return

    def _check_owner(self, version: StoredVersion | None) -> None:
        """Note where the object was deleted or taken over."""
        if version is None:
            self._loss_reason = "its object was deleted"
        elif not _is_owned_by(self._owner, version):
            self._loss_reason = "another process took it over"

    def _check_age(self) -> None:
        """Note where the claim has not been renewed for its lifetime."""
        age_s = _clock_s() - self._renewed_s
        if age_s > self._times.lifetime_s and not self._loss_reason:
            self._loss_reason = (
                f"it was not renewed for {age_s:.0f} s, and counts as given up after "
                f"{self._times.lifetime_s:.0f} s"
            )


def _contend(store: RemoteStore, path: str, times: ClaimTimes) -> _ObjectClaim | None:
    """Try to become the holder; return None where another holder lives."""
    owner = secrets.token_hex(8)
    version = None
    _store_clock_s(store)
    for _ in range(_MAX_RACES):
        start_s = _clock_s()
        version = store.put_if(path, _record(owner), version)
        if version is None:  # its holder has released it meanwhile
            continue
        if _is_owned_by(owner, version):
            is_fresh = _clock_s() - start_s < times.lifetime_s
            return _ObjectClaim(store, path, times, owner, version, start_s) if is_fresh else None
        if _store_clock_s(store) - version.modified_s <= times.lifetime_s + _RESOLUTION_S:
            return None
        _log.warning("%s: taking over %s from a process that has died", store.uri, path)
    return None


def _record(owner: str) -> bytes:
    """Return the record of a holder.

    It is never the same twice, so that no two versions look equal.
    """
    facts = {"owner": owner, "host": socket.gethostname(), "process": os.getpid()}
    return json.dumps(facts | {"put": secrets.token_hex(8)}).encode()


def _is_owned_by(owner: str, version: StoredVersion) -> bool:
    """Return True if the version of the object was written by this owner."""
    return owner.encode() in version.data


def _store_clock_s(store: RemoteStore) -> float:
    """Return a time that the store's clock has passed, read with a short-lived object.

    Raises:
        OutputError: The store puts objects where it should refuse.
    """
    read_s, ahead_s = _clocks.get(store.uri, (-math.inf, 0.0))
    if _clock_s() - read_s > _CLOCK_AGE_S:
        path = f"{STATE_FOLDER}/clock/{secrets.token_hex(8)}"
        first_version = store.put_if(path, b"1", None)
        store.put_if(path, b"2", first_version)
        read_s = _clock_s()
        versions = [store.put_if(path, b"3", first_version), store.put_if(path, b"4", None)]
        store.delete([path])
        if versions[0] is None or [version and version.data for version in versions] != [
            b"2",
            b"2",
        ]:
            raise OutputError(
                f"{store.uri}: this store ignores If-None-Match or If-Match, so several processes "
                f"cannot share an output there; use another store, or a folder of this machine"
            )
        ahead_s = versions[0].modified_s - read_s
        _clocks[store.uri] = (read_s, ahead_s)
    return _clock_s() + ahead_s


def _clock_s() -> float:
    """Return seconds that go on while the machine sleeps, where the system has such a clock."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))
