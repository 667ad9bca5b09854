"""A memory of recent results that never holds more than so many bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


class ByteCache(Generic[T]):
    """Results by key; the ones unused for longest are forgotten when `limit_bytes` is exceeded.

    What is larger than the limit is never kept. Not safe for several threads at once."""

    def __init__(self, limit_bytes: int) -> None:
        if limit_bytes < 0:
            raise ValueError(f"limit_bytes must be >= 0; got {limit_bytes}")
        self._limit = limit_bytes
        self._held = 0
        self._items: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()

    def has_room(self, nbytes: int) -> bool:
        """Whether so much more fits without forgetting anything."""
        return self._held + nbytes <= self._limit

    def get(self, key: Hashable) -> T | None:
        entry = self._items.get(key)
        if entry is None:
            return None
        self._items.move_to_end(key)
        return entry[0]

    def put(self, key: Hashable, value: T, nbytes: int) -> None:
        old = self._items.pop(key, None)
        if old is not None:
            self._held -= old[1]
        if nbytes > self._limit:
            return
        while self._held + nbytes > self._limit:
            _, (_, freed) = self._items.popitem(last=False)
            self._held -= freed
        self._items[key] = (value, nbytes)
        self._held += nbytes
