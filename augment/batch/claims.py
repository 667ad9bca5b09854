"""One process at a time at one piece of an output, among processes and machines.

On a local store a claim is the kernel's lock of a file (flock): it ends with the process, and with
the children that it forked, however they end.

On a remote store every contender writes an object of its own, and then lists all of them: who sees
another live one withdraws. Object stores list what was written before, so of two contenders at
least one sees the other, and two can never both stay. A thread renews the object; one that has not
been renewed for the lifetime, by the clock of the store, is dead, and may be deleted by anyone.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from augment.batch.layout import STATE_FOLDER, folder_name
from augment.batch.store import Store
from augment.errors import OutputError

CLAIMS_FOLDER = f"{STATE_FOLDER}/claims"


@dataclass(frozen=True)
class ClaimTimes:
    """How often a remote claim is renewed, when one counts as dead, and how contenders part.

    The lifetime must exceed the renewal several times.
    Contenders that see each other try again, `attempts` times in all, each after a random wait.
    """

    renewal_s: float = 20.0
    lifetime_s: float = 90.0
    attempts: int = 4
    longest_wait_s: float = 0.5


CLAIM_TIMES = ClaimTimes()


@runtime_checkable
class Claim(Protocol):
    """Held by this process until released; leaving its `with` block releases it."""

    def check(self) -> None:
        """Make sure that it is still held.

        Raises:
            OutputError: it was lost; others may hold it now.
        """
        ...

    def release(self) -> None:
        """Give it up, for others to take; a second time, or in a forked child, does nothing."""
        ...

    def __enter__(self) -> Claim: ...

    def __exit__(self, *_: object) -> None: ...


def try_claim(store: Store, name: str, times: ClaimTimes | None = None) -> Claim | None:
    """The claim of that name, or None: a live process, here or elsewhere, holds it.

    The name is one component of a path: letters, digits, `.`, `_`, `-` (see layout.folder_name).

    Raises:
        OutputError: the store cannot be read or written. ValueError: another name.
    """
    if folder_name(name) != name:
        raise ValueError(
            f"a claim's name must be letters, digits, '.', '_' and '-', at most 100 of them, the "
            f"first a letter or digit; got {name!r}. layout.folder_name makes such names"
        )
    if store.local_dir is not None:
        from augment.batch.local_claims import try_lock

        return try_lock(store.local_dir / CLAIMS_FOLDER / f"{name}.lock")
    from augment.batch.remote_claims import contend

    return contend(store, f"{CLAIMS_FOLDER}/{name}", times or CLAIM_TIMES)


@contextlib.contextmanager
def hold(store: Store, name: str, patience_s: float = 120.0) -> Iterator[None]:
    """Be inside with the claim; waits for others that are.

    Raises:
        OutputError: they took longer than that.
    """
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
