"""The rows of a camera's image (`plane_rows`) on the GPU, copied once a camera."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from jaxtyping import Int32
from torch import Tensor

from augment.cameras import Camera
from augment.render.gpu import gpu_device, upload
from augment.weather.plane_rows import BEGIN, END, falling_rows

_known: WeakKeyDictionary[Camera, tuple[Tensor, int]] = WeakKeyDictionary()


def rows_on_gpu(camera: Camera) -> Int32[Tensor, "H 4"]:
    return _known_of(camera)[0]


def dry_rows(camera: Camera) -> int:
    """One past the last row in which a ray does not fall."""
    return _known_of(camera)[1]


def _known_of(camera: Camera) -> tuple[Tensor, int]:
    known = _known.get(camera)
    if known is None or known[0].device != gpu_device():
        rows = falling_rows(camera)
        is_dry = (rows[:, BEGIN] > 0) | (rows[:, END] < camera.width)
        known = _known[camera] = upload(rows), int(is_dry.nonzero()[0].max(initial=-1)) + 1
    return known
