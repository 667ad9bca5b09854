"""Work space of the CPU rasteriser, kept between frames: fresh pages cost as much as the work.

Every render takes a space of its own, so threads that render at once never share one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

_LINE = 64  # bytes of a cache line
_KEPT = 2  # spaces kept for later renders; a process rarely renders in more threads
_SPACES: deque[Scratch] = deque(maxlen=_KEPT)  # append and pop are atomic


class Scratch:
    """Named arrays that keep their memory; each grows to the largest size asked for."""

    def __init__(self) -> None:
        self._buffers: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        """An array that starts at a cache line, with whatever the last render left in it."""
        count = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        buffer = self._buffers.get(name)
        if buffer is None or buffer.nbytes < count:
            raw = np.empty(count + count // 8 + _LINE, np.uint8)  # some room for the next frame
            start = -raw.ctypes.data % _LINE
            buffer = self._buffers[name] = raw[start:]
        return buffer[:count].view(dtype).reshape(shape)

    @property
    def nbytes(self) -> int:
        return sum(buffer.nbytes for buffer in self._buffers.values())


@contextmanager
def borrowed_scratch() -> Iterator[Scratch]:
    """A space for one render, handed back afterwards."""
    try:
        scratch = _SPACES.pop()
    except IndexError:
        scratch = Scratch()
    try:
        yield scratch
    finally:
        _SPACES.append(scratch)


def release_scratch() -> None:
    """Give all kept memory back; the next render takes it anew."""
    _SPACES.clear()
