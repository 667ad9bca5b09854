"""One process at a time at one piece of an output, among processes and machines.

On a local store a claim is the kernel's lock of a file (flock): it ends with the process, and with
the children that it forked, however they end.

On a remote store every contender writes an object of its own, and then lists all of them: who sees
another live one withdraws. Object stores list what was written before, so of two contenders at
least one sees the other, and two can never both stay. A thread renews the object; one that has not
been renewed for the lifetime, by the clock of the store, is dead, and may be deleted by anyone.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import json
import logging
import os
import secrets
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import SystemRandom

from augment.errors import OutputError
from augment.jobs.atomic import is_named, make_folder, output_error, refusals_of
from augment.jobs.layout import STATE_FOLDER, folder_name
from augment.jobs.store import Store

# ---- Among the processes of one machine: the kernel's lock of a file -----------------------------

_MAX_RACES = 1000  # times that the file is deleted by its holder while it is being opened


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
            if is_named(self._path, descriptor):
                self._path.unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # where there are no others
                    self._path.parent.rmdir()
        except OSError as error:
            raise output_error(self._path, error) from error
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # for forked children too
            os.close(descriptor)


def try_lock(path: Path) -> FileClaim | None:
    """Lock the file, which is made if missing; None where another process holds it."""
    with refusals_of(path):
        for _ in range(_MAX_RACES):
            make_folder(path.parent)
            try:
                descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            except FileNotFoundError:  # somebody has deleted the folder
                continue
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if is_named(path, descriptor):
                    return FileClaim(path, descriptor)
            except BlockingIOError:
                os.close(descriptor)
                return None
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)  # a holder has deleted it since: lock the next one
    return None


# ---- Claims --------------------------------------------------------------------------------------

CLAIMS_FOLDER = f"{STATE_FOLDER}/claims"


@dataclass(frozen=True)
class ClaimTimes:
    """How often a remote claim is renewed, when one counts as dead, and how contenders part. The
    lifetime must exceed the renewal several times. Contenders that see each other try again,
    `attempts` times in all, each after a random wait.
    """

    renewal_s: float = 20.0
    lifetime_s: float = 90.0
    attempts: int = 4
    longest_wait_s: float = 0.5


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
        return try_lock(store.local_dir / CLAIMS_FOLDER / f"{name}.lock")

    return contend(store, f"{CLAIMS_FOLDER}/{name}", times or CLAIM_TIMES)


@contextlib.contextmanager
def hold(store: Store, name: str, patience_s: float = 120.0) -> Iterator[None]:
    """Be inside with the claim; waits for others that are."""
    deadline = time.monotonic() + patience_s
    while (claim := try_claim(store, name)) is None:
        if time.monotonic() > deadline:
            raise OutputError(
                f"{store.uri}: another process has held the claim {name!r} for {patience_s:.0f} s; "
                f"end it, then run the same command again"
            )
        time.sleep(0.05)
    with claim:
        yield


# ---- Among machines that share nothing but a remote store ----------------------------------------
# Whoever contends has an empty object, whoever holds the claim one that says who it is.

_log = logging.getLogger(__name__)
_RESOLUTION_S = 1.0  # of the times that stores tell
_random = SystemRandom()  # processes with one seed must part


class ObjectClaim(Claim):
    """An object that a thread renews."""

    def __init__(self, store: Store, path: str, times: ClaimTimes, renewed_s: float) -> None:
        self._store, self._path, self._times = store, path, times
        self._renewed_s = renewed_s  # before the object was last written, by this machine's clock
        self._lost = ""
        self._is_released = False
        self._process = os.getpid()
        self._stop = threading.Event()
        name = f"renews {path}"
        self._thread = threading.Thread(target=self._keep_renewing, name=name, daemon=True)
        self._thread.start()
        atexit.register(self.release)

    def check(self) -> None:
        is_ours = self._process == os.getpid()  # a forked child does not see renewals
        if is_ours and not self._lost and not self._is_released:
            self._note_age()
        if not self._lost and not self._is_released and not self._store.exists(self._path):
            self._lost = "its object was deleted"
        if self._lost or self._is_released:
            raise OutputError(
                f"the claim {self._path} of {self._store.uri} is lost: "
                f"{self._lost or 'it was released'}. Another process may be at work on the same "
                f"files; run the same command again when it has ended"
            )

    def release(self) -> None:
        if self._is_released or self._process != os.getpid():
            return
        self._is_released = True
        atexit.unregister(self.release)
        self._stop.set()
        self._thread.join()  # a renewal under way would bring the object back
        _withdraw(self._store, self._path, self._times)

    def _keep_renewing(self) -> None:
        while not self._lost and not self._stop.wait(self._times.renewal_s):
            try:
                self._renew()
            except OutputError as error:
                _log.warning("a claim was not renewed: %s", error)
                self._note_age()

    def _renew(self) -> None:
        started_s = _clock_s()
        if not self._store.exists(self._path):
            self._lost = "its object was deleted"
            return
        self._store.write(self._path, _who())
        # One that came too late may stand beside another holder's object by now.
        self._note_age()
        if self._lost:
            _withdraw(self._store, self._path, self._times)
        else:
            self._renewed_s = started_s

    def _note_age(self) -> None:
        age_s = _clock_s() - self._renewed_s
        if age_s > self._times.lifetime_s:
            self._lost = (
                f"it was not renewed for {age_s:.0f} s, and counts as given up after "
                f"{self._times.lifetime_s:.0f} s"
            )


def contend(store: Store, folder: str, times: ClaimTimes) -> ObjectClaim | None:
    """Try to become the holder; None where another one lives, or too many contend at once."""
    for attempt in range(times.attempts):
        path = f"{folder}/{secrets.token_hex(8)}"
        started_s = _clock_s()
        is_held = is_alone = False
        store.write(path, b"")
        try:
            is_held, is_alone = _look_around(store, folder, path, times)
            if is_alone:
                store.write(path, _who())
                # Past its lifetime, others have taken it for dead, and one of them may hold it.
                is_alone = _clock_s() - started_s <= times.lifetime_s
                if is_alone:
                    return ObjectClaim(store, path, times, started_s)
        finally:
            if not is_alone:
                _withdraw(store, path, times)
        if is_held:
            return None
        if attempt + 1 < times.attempts:
            time.sleep(_random.uniform(0, times.longest_wait_s * 2**attempt))
    return None


def _look_around(store: Store, folder: str, own: str, times: ClaimTimes) -> tuple[bool, bool]:
    """Whether another live process holds the claim, and whether there is no other at all."""
    objects = store.list(folder)
    if own not in objects:
        return False, False  # deleted as dead: this machine stood still for that long
    now_s = objects.pop(own).modified_s
    longest_s = times.lifetime_s + _RESOLUTION_S
    alive = {path: o for path, o in objects.items() if now_s - o.modified_s <= longest_s}
    dead = sorted(objects.keys() - alive.keys())
    if dead:
        _log.warning("%s: claims of processes that have died: %s", store.uri, ", ".join(dead))
        store.delete(dead)
    return any(other.size > 0 for other in alive.values()), not alive


def _withdraw(store: Store, path: str, times: ClaimTimes) -> None:
    try:
        store.delete([path])
    except OutputError as error:
        _log.warning("a claim ends only in %.0f s, by itself: %s", times.lifetime_s, error)


def _who() -> bytes:
    return json.dumps({"host": socket.gethostname(), "process": os.getpid()}).encode()


def _clock() -> Callable[[], float]:
    """Seconds that go on while the machine sleeps, where the system has such a clock."""
    if hasattr(time, "CLOCK_BOOTTIME"):
        return lambda: time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic


_clock_s = _clock()
