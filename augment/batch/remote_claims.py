"""Claims among machines that share nothing but a remote store; the protocol is told in claims.py.

Whoever contends has an empty object, whoever holds the claim one that says who it is.
"""

from __future__ import annotations

import atexit
import json
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from random import SystemRandom

from augment.batch.claims import ClaimTimes
from augment.batch.store import Store
from augment.errors import OutputError

_log = logging.getLogger(__name__)
_RESOLUTION_S = 1.0  # of the times that stores tell
_random = SystemRandom()  # processes with one seed must part


class ObjectClaim:
    """An object that a thread renews; see Claim."""

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

    def __enter__(self) -> ObjectClaim:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

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
    """Try to become the holder; None where another one lives, or too many contend at once.

    Raises:
        OutputError: the store cannot be read or written.
    """
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
