"""The rows of a camera's image (`plane_rows`) on the GPU, copied once a camera."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from jaxtyping import Int32
from torch import Tensor

from augment.cameras import Camera
from augment.render.gpu import gpu_device, upload
from augment.weather.plane_rows import falling_rows

_known: WeakKeyDictionary[Camera, Tensor] = WeakKeyDictionary()


def rows_on_gpu(camera: Camera) -> Int32[Tensor, "H 4"]:
    known = _known.get(camera)
    if known is None or known.device != gpu_device():
        known = _known[camera] = upload(falling_rows(camera))
    return known
