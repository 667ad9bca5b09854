"""What has been worked out once for a scene, or for another object that cannot change.

`memo_of(scene).get(key, make)` makes a value at its first use and keeps it while its owner lives,
at most MAX_BYTES an owner beside the largest value: those unused for longest go first. Values that
a job's worker processes need, too, are `put` with `shared=True`: `shared()` gives them, `update`
takes them over.
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

MAX_BYTES = 1 << 29
Value = TypeVar("Value")


@runtime_checkable
class Stored(Protocol):
    """A value that lies in a file, in place of the value itself; picklable."""

    def load(self) -> Any: ...


class SceneMemo:
    """Values by key, of one owner. Threads may share it: one makes a value, the others wait."""

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._values: OrderedDict[Hashable, Any] = OrderedDict()
        self._sizes: dict[Hashable, int] = {}
        self._shared: dict[Hashable, Any] = {}
        self._lock = threading.Lock()
        self._making: dict[Hashable, threading.RLock] = {}  # keys hold objects: only while made

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The key's value; made, and kept, where it is not known. It must not refer to its owner,
        which it would keep alive.
        """
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
            making = self._making.setdefault(key, threading.RLock())
        with making:
            with self._lock:
                if key in self._values:  # made while this thread waited
                    return self._values[key]
                given = self._shared.get(key)
            try:
                value = given.load() if isinstance(given, Stored) else given
                return self._keep(key, make() if value is None else value)
            finally:
                with self._lock:
                    self._making.pop(key, None)

    def known(self, key: Hashable) -> bool:
        """Whether `get` would make nothing."""
        with self._lock:
            return key in self._values or key in self._shared

    def put(self, key: Hashable, value: Any, *, shared: bool = False) -> None:
        """Keep a value in place of what the key had. shared: hand it, or the file it is Stored in,
        to worker processes; it is kept whatever its size.
        """
        with self._lock:
            self._values.pop(key, None)
            if shared:
                self._shared[key] = value
        if not isinstance(value, Stored):
            self._keep(key, value)

    def shared(self) -> dict[Hashable, Any]:
        """What was put as shared; picklable if its values are."""
        with self._lock:
            return dict(self._shared)

    def update(self, shared: Mapping[Hashable, Any]) -> None:
        """Take over what another process's memo shares."""
        for key, value in shared.items():
            self.put(key, value, shared=True)

    def _keep(self, key: Hashable, value: Value) -> Value:
        size = size_of(value)
        with self._lock:
            self._values[key], self._sizes[key] = value, size
            self._values.move_to_end(key)
            sizes = {k: self._sizes[k] for k in self._values}
            # The largest counts nothing: one that is beyond the limit would drive out all others,
            # and they it, frame after frame.
            left = sum(sizes.values()) - max(sizes.values()) - self._max_bytes
            for old in [k for k, bytes_ in sizes.items() if bytes_ and k != key]:
                if left <= 0:
                    break
                del self._values[old]
                left -= self._sizes.pop(old)
        return value


class Latest:
    """The value of the last key that was asked for. Threads may share it: one makes the value."""

    def __init__(self) -> None:
        self._kept: tuple[Hashable, Any] | None = None
        self._making = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        with self._making:
            if self._kept is None or self._kept[0] != key:
                self._kept = key, make()
            return self._kept[1]


def memo_of(owner: Any) -> SceneMemo:
    """The memo of a scene, or of any object that is hashed by identity; it goes when that goes."""
    with _lock:
        memo = _memos.get(owner)
        if memo is None:
            memo = _memos[owner] = SceneMemo()
        return memo


_memos: WeakKeyDictionary[Any, SceneMemo] = WeakKeyDictionary()
_lock = threading.Lock()


def size_of(value: Any) -> int:
    """Bytes of the arrays and tensors in a value: in records, tuples and mappings, too. One that
    holds what is its owner's says what it adds to that by an attribute `own_bytes`.
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
