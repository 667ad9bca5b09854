"""Memo of values that are computed once for a scene, or for another object that cannot change.

`memo_of(scene).get(key, make)` makes a value at its first use and keeps it while its owner lives.
An owner keeps at most MAX_BYTES beside its largest value; values that have not been used for
longest go first. Values that a job's worker processes also need are `put` with `shared=True`:
`shared()` returns them, and `take_shared` takes them over.
"""

from __future__ import annotations

import dataclasses
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Protocol, TypeVar, runtime_checkable
from weakref import WeakKeyDictionary

import numpy as np
from torch import Tensor

# Bytes that an owner keeps, beside its largest value.
MAX_BYTES = 1 << 29
Value = TypeVar("Value")


@runtime_checkable
class StoredValue(Protocol):
    """A value that lies in a file, in place of the value itself; picklable."""

    def load(self) -> Any:
        """Return the value."""
        ...


class SceneMemo:
    """Values of one owner, by key.

    Threads may share a memo: one makes a value, the others wait for it.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._values: OrderedDict[Hashable, Any] = OrderedDict()
        self._sizes: dict[Hashable, int] = {}
        self._shared: dict[Hashable, Any] = {}
        self._lock = threading.Lock()
        self._making: dict[
            Hashable, threading.RLock
        ] = {}  # only while made, since keys hold objects

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the key's value; make and keep it where it is not known.

        Args:
            key: the key.
            make: makes the value, which must not refer to its owner: it would keep the owner alive.
        """
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
            key_lock = self._making.setdefault(key, threading.RLock())
        with key_lock:
            with self._lock:
                if key in self._values:  # made while this thread waited
                    return self._values[key]
                shared_value = self._shared.get(key)
            try:
                value = (
                    shared_value.load() if isinstance(shared_value, StoredValue) else shared_value
                )
                return self._keep(key, make() if value is None else value)
            finally:
                with self._lock:
                    self._making.pop(key, None)

    def has(self, key: Hashable) -> bool:
        """Return True if `get` would make nothing."""
        with self._lock:
            return key in self._values or key in self._shared

    def put(self, key: Hashable, value: Any, *, shared: bool = False) -> None:
        """Keep a value in place of the key's earlier one.

        Args:
            key: the key.
            value: the value, or a StoredValue that loads it.
            shared: if True, hand the value, or the file it is stored in, to worker processes; it is
                kept whatever its size.
        """
        with self._lock:
            self._values.pop(key, None)
            if shared:
                self._shared[key] = value
        if not isinstance(value, StoredValue):
            self._keep(key, value)

    def shared(self) -> dict[Hashable, Any]:
        """Return the values that were put as shared; picklable if the values are."""
        with self._lock:
            return dict(self._shared)

    def take_shared(self, shared: Mapping[Hashable, Any]) -> None:
        """Take over the values that another process's memo shares."""
        for key, value in shared.items():
            self.put(key, value, shared=True)

    def _keep(self, key: Hashable, value: Value) -> Value:
        """Keep a value, and drop unused values beyond the limit."""
        size = size_of(value)
        with self._lock:
            self._values[key] = value
            self._sizes[key] = size
            self._values.move_to_end(key)
            sizes = {k: self._sizes[k] for k in self._values}
            # The largest value is not counted: one beyond the limit would drive out all others, and
            # they would drive it out, frame after frame.
            excess_bytes = sum(sizes.values()) - max(sizes.values()) - self._max_bytes
            for old_key in [k for k, num_bytes in sizes.items() if num_bytes and k != key]:
                if excess_bytes <= 0:
                    break
                del self._values[old_key]
                excess_bytes -= self._sizes.pop(old_key)
        return value


class LatestValue:
    """The value of the last key that was asked for.

    Threads may share it: one makes the value.
    """

    def __init__(self) -> None:
        self._entry: tuple[Hashable, Any] | None = None
        self._making = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the key's value; make it where another key was the last."""
        with self._making:
            if self._entry is None or self._entry[0] != key:
                self._entry = key, make()
            return self._entry[1]


def memo_of(owner: Any) -> SceneMemo:
    """Return the memo of a scene, or of any object that is hashed by identity.

    It goes when its owner goes.
    """
    with _lock:
        memo = _memos.get(owner)
        if memo is None:
            memo = _memos[owner] = SceneMemo()
        return memo


def share_memo(owner: Any, other: Any) -> None:
    """Give an object the memo of another one, for two that differ in nothing that is computed.

    Args:
        owner: the object with the memo.
        other: the object that gets it.
    """
    memo = memo_of(owner)
    with _lock:
        _memos[other] = memo


_memos: WeakKeyDictionary[Any, SceneMemo] = WeakKeyDictionary()
_lock = threading.Lock()


def size_of(value: Any) -> int:
    """Return the bytes of arrays and tensors in a value, also inside records, tuples and mappings.

    A value that holds parts of its owner states in an attribute `own_bytes` what it adds to them.
    """
    own_bytes = getattr(value, "own_bytes", None)
    if isinstance(own_bytes, int):
        return own_bytes
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, np.ndarray):
        return value.nbytes
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return sum(size_of(getattr(value, field.name)) for field in dataclasses.fields(value))
    if isinstance(value, Mapping):
        return sum(map(size_of, value.values()))
    if isinstance(value, tuple | list):
        return sum(map(size_of, value))
    return 0
