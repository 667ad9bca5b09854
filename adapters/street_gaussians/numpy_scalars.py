"""Checkpoints that hold NumPy's numbers beside their tensors.

A model that is saved before the end of its training holds such a number for every part, which only
training needs. It is passed over without calling NumPy: what a hostile file says of it is nowhere
evaluated.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch

_NAMES = (
    "numpy.core.multiarray.scalar",  # as NumPy 1 writes it
    "numpy._core.multiarray.scalar",
    "numpy.dtype",
)


class PassedOver:
    """Stands for a value that was not read."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, _: object) -> None: ...


@contextlib.contextmanager
def passing_over_numpy_scalars() -> Iterator[None]:
    """While this is open, torch reads NumPy's numbers as `PassedOver`."""
    with torch.serialization.safe_globals([(PassedOver, name) for name in _NAMES]):
        yield
