"""Small arrays of a frame that travel to the GPU together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from augment.render.gpu import upload

_ALIGNED = 4  # words of 4 bytes, at multiples of which every array begins
_DTYPES = {"i4": torch.int32, "i8": torch.int64, "f4": torch.float32}


def upload_together(arrays: Sequence[np.ndarray]) -> list[Tensor]:
    """Copies on the GPU, for this frame only, of int32, int64 and float32 arrays: one upload."""
    starts, end = [], 0
    for array in arrays:
        starts.append(end)
        end += -(-(array.nbytes // 4) // _ALIGNED) * _ALIGNED
    words = np.zeros(end, np.int32)
    for start, array in zip(starts, arrays, strict=True):
        own = words[start : start + array.nbytes // 4].view(array.dtype)
        own[:] = array.reshape(-1)
    packed = upload(words)
    return [
        packed[start : start + array.nbytes // 4]
        .view(_DTYPES[array.dtype.str[1:]])
        .reshape(array.shape)
        for start, array in zip(starts, arrays, strict=True)
    ]
