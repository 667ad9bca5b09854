"""Small arrays of a frame that travel to the GPU together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from augment.render.gpu import upload

_ALIGNMENT = 16  # bytes, at multiples of which every array begins


def upload_together(arrays: Sequence[np.ndarray]) -> list[Tensor]:
    """Copies on the GPU, for this frame only, of arrays of 4 or 8 bytes a number: one upload."""
    ends, pieces = [0], []
    for array in arrays:
        words = np.ascontiguousarray(array).reshape(-1).view(np.int32)
        padding = -len(words) % (_ALIGNMENT // words.itemsize)
        pieces += [words, np.zeros(padding, np.int32)]
        ends.append(ends[-1] + len(words) + padding)
    packed = upload(np.concatenate(pieces))
    out = []
    for array, start in zip(arrays, ends, strict=False):
        words = packed[start : start + array.nbytes // packed.itemsize]
        dtype = torch.from_numpy(np.empty(0, array.dtype)).dtype
        out.append(words.view(dtype).reshape(array.shape))
    return out
